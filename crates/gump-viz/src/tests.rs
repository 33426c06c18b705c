//! Whole pictures, films and pages.

use gump_geometry::dvec2;
use gump_raster::{Layer, RasterSpec, rasterize};
use gump_scene::{AgentId, AgentState, Frame, Rollout, Scenario, fixture};

use crate::theme::{Rgb, mix};
use crate::{
    Camera, CandidatePath, Chart, FilmSpec, LabelledRollout, Page, Picture, PictureSpec, Series,
    Theme, VizError, draw_candidates, draw_futures, draw_raster_layer, draw_scene, grid_film,
    log_as_rollout, overlay_film,
};

fn street() -> Scenario {
    fixture::scenario(
        "lane 1: -40,0 40,0 width 4 next 2
         lane 2: 40,0 90,0 width 4
         lane 3: 60,4 -40,4 width 4
         edge: -40,-2.2 90,-2.2
         line: -40,2 40,2
         crosswalk: 8,-2 11,-2 11,6 8,6
         light 1 red: 6,0
         route 1,2
         ego vehicle 0: 0,0 velocity 5,0
         agent vehicle 1: 16,4 velocity -6,0
         agent bicycle 2: -9,-1 velocity 3,0
         agent pedestrian 3: 9.5,7 velocity 0,-1
         agent other 4: 3,-4 size 2,2
         history 1.0 future 2.0 dt 0.1",
    )
    .unwrap()
}

fn camera(scenario: &Scenario) -> Camera {
    Camera::on_ego(&scenario.present(), 24.0, 48, 64)
}

fn pixel(picture: &Picture, camera: &Camera, x: f64, y: f64) -> Rgb {
    let at = camera.pixel(dvec2(x, y));
    let i = (at.y as usize * picture.width + at.x as usize) * 4;
    [picture.rgba[i], picture.rgba[i + 1], picture.rgba[i + 2]]
}

/// The letter of the theme colour nearest to each pixel.
fn as_text(picture: &Picture, theme: Theme) -> String {
    let c = theme.colours();
    let letters = [
        (c.ground, ' '),
        (c.road, '.'),
        (c.route, ','),
        (c.edge, '|'),
        (c.crosswalk, ' '),
        (c.ego, 'E'),
        (c.vehicle, 'V'),
        (c.pedestrian, 'P'),
        (c.bicycle, 'B'),
        (c.other, 'O'),
        (c.outline, '#'),
        (c.red, 'R'),
    ];
    let letter = |p: &[u8]| {
        let distance = |c: Rgb| {
            (0..3)
                .map(|i| (i32::from(c[i]) - i32::from(p[i])).pow(2))
                .sum()
        };
        letters
            .iter()
            .min_by_key(|l| -> i32 { distance(l.0) })
            .unwrap()
            .1
    };
    let rows = picture.rgba.chunks(picture.width * 4);
    let rows = rows.map(|row| row.chunks(4).map(letter).collect::<String>());
    rows.collect::<Vec<_>>().join("\n")
}

#[test]
fn a_street_looks_like_a_street() {
    let scenario = street();
    let mut spec = PictureSpec::new(camera(&scenario));
    spec.scale_bar = false;
    spec.past_s = 0.0;
    let picture = draw_scene(&scenario.present(), &spec);
    insta::assert_snapshot!(as_text(&picture, Theme::Light));
}

#[test]
fn things_have_their_colours_in_both_themes() {
    let scenario = street();
    let camera = camera(&scenario);
    for theme in [Theme::Light, Theme::Dark] {
        let spec = PictureSpec::new(camera).with_theme(theme);
        let picture = draw_scene(&scenario.present(), &spec);
        let colours = theme.colours();
        let check = |x, y, expected| assert_eq!(pixel(&picture, &camera, x, y), expected);
        check(0.0, 0.0, colours.ego);
        check(9.5, 7.0, colours.pedestrian);
        check(3.0, -4.0, colours.other);
        check(6.0, 0.0, colours.red);
        check(3.0, 4.0, colours.road);
        check(-6.0, 9.0, colours.ground);
        let halo = pixel(&picture, &camera, 3.0, 0.0);
        let expected = mix(colours.route, colours.ego, 0.3);
        assert!(
            (0..3).all(|i| halo[i].abs_diff(expected[i]) <= 2),
            "{halo:?}"
        );
    }
}

#[test]
fn trails_lead_backwards_and_futures_forwards() {
    let scenario = street();
    let camera = camera(&scenario);
    let mut spec = PictureSpec::new(camera);
    let changed =
        |a: &Picture, b: &Picture, x| pixel(a, &camera, x, 0.0) != pixel(b, &camera, x, 0.0);
    spec.past_s = 0.0;
    let bare = draw_scene(&scenario.present(), &spec);
    let ahead = draw_futures(&scenario.present(), &[scenario.future()], &spec);
    spec.past_s = 1.0;
    let behind = draw_scene(&scenario.present(), &spec);
    assert!(changed(&bare, &behind, -4.5) && !changed(&bare, &behind, 7.5));
    assert!(changed(&bare, &ahead, 7.5) && !changed(&bare, &ahead, -4.5));
}

#[test]
fn a_png_reads_back_as_it_was() {
    let scenario = street();
    let spec = PictureSpec::new(camera(&scenario)).with_label("A street, 24 m");
    let picture = draw_scene(&scenario.present(), &spec);
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("street.png");
    picture.save_png(&path).unwrap();
    let read = image::open(&path).unwrap().to_rgba8();
    assert_eq!(read.dimensions(), (48, 64));
    assert_eq!(read.into_raw(), picture.rgba);
    let error = picture
        .save_png(&folder.path().join("no/such/folder.png"))
        .unwrap_err();
    assert!(matches!(error, VizError::Write { .. }));
    let no_pixels = Picture {
        width: 3,
        ..picture
    };
    assert!(matches!(
        no_pixels.to_png(),
        Err(VizError::Size { width: 3, .. })
    ));
}

#[test]
fn a_raster_layer_is_a_picture() {
    let scenario = street();
    let scene = scenario.present();
    let spec = RasterSpec::new(8, 4.0, vec![Layer::Agents, Layer::CoordinateX]);
    let raster = rasterize(&spec, &scene, scene.ego_now().state.pose);
    let draw = |layer| draw_raster_layer(&raster, layer, 3, Theme::Dark);
    let agents = draw(Layer::Agents).unwrap();
    assert_eq!((agents.width, agents.rgba.len()), (24, 24 * 24 * 4));
    let n_blue = agents
        .rgba
        .chunks(4)
        .filter(|p| p[..3] == Theme::Dark.colours().vehicle)
        .count();
    let n_drawn = raster.layer(0).iter().filter(|&&v| v == 1.0).count();
    assert_eq!(n_blue, n_drawn * 9);
    assert!(draw(Layer::Route).is_none());
}

/// The ego of `log` moved sideways; a future that differs.
fn swerving(scenario: &Scenario) -> Rollout {
    let mut rollout = Rollout::begin(scenario.present());
    for (i, frame) in scenario.future().iter().enumerate() {
        let agents = frame.agents().iter().map(|&agent| {
            let mut state: AgentState = agent.state;
            if agent.id == AgentId(0) {
                state.pose.position.y += 0.15 * i as f64;
            }
            agent.with_state(state)
        });
        rollout.push(Frame::new(agents.collect(), frame.lights().to_vec()));
    }
    rollout
}

/// Plays a GIF as a viewer does: the delays, and the picture after the last frame.
fn play(gif: &[u8]) -> (Vec<u16>, Vec<Rgb>) {
    let mut decoder = gif::DecodeOptions::new().read_info(gif).unwrap();
    let palette = decoder.global_palette().unwrap().to_vec();
    let (width, height) = (usize::from(decoder.width()), usize::from(decoder.height()));
    let mut screen = vec![[0; 3]; width * height];
    let mut delays = Vec::new();
    while let Some(frame) = decoder.read_next_frame().unwrap() {
        delays.push(frame.delay);
        for (i, &index) in frame.buffer.iter().enumerate() {
            let row = usize::from(frame.top) + i / usize::from(frame.width);
            let column = usize::from(frame.left) + i % usize::from(frame.width);
            if frame.transparent != Some(index) {
                let rgb = &palette[usize::from(index) * 3..][..3];
                screen[row * width + column] = [rgb[0], rgb[1], rgb[2]];
            }
        }
    }
    (delays, screen)
}

#[test]
fn a_film_of_two_futures_plays_side_by_side() {
    let scenario = street();
    let (log, swerve) = (log_as_rollout(&scenario), swerving(&scenario));
    let mut spec = FilmSpec::new(camera(&scenario));
    (spec.frame_s, spec.speed) = (0.2, 2.0);
    spec.past_s = 0.0;
    let take = |rollout, label: &str| LabelledRollout {
        rollout,
        label: label.into(),
    };
    let film = grid_film(&[take(&log, ""), take(&swerve, "")], &spec).unwrap();
    assert_eq!(
        (film.width, film.height, film.n_frames),
        (98, 64 + 2 + 24, 11)
    );
    let (delays, screen) = play(&film.gif);
    // Two seconds in steps of 0.2 s, twice as fast; the last frame stays.
    assert_eq!(delays, [vec![10; 10], vec![120]].concat());
    let ego = Theme::Light.colours().ego;
    let shows_ego = |panel: usize, x, y| {
        let at = spec.camera.pixel(dvec2(x, y));
        screen[at.y as usize * film.width + panel * 50 + at.x as usize] == ego
    };
    // At 5 m/s the ego is 10 m ahead at the end, on top of where others are drawn.
    assert!(shows_ego(0, 10.0, 0.0) && !shows_ego(0, 10.0, 2.85));
    assert!(shows_ego(1, 10.0, 2.85) && !shows_ego(1, 10.0, -0.8));
}

/// Plays an animated PNG: delays in hundredths of a second, and the last picture.
fn play_apng(bytes: &[u8]) -> (Vec<u16>, Vec<Rgb>) {
    let mut decoder = png::Decoder::new(std::io::Cursor::new(bytes));
    decoder.set_transformations(png::Transformations::EXPAND);
    let mut reader = decoder.read_info().unwrap();
    let (width, height) = (reader.info().width as usize, reader.info().height as usize);
    let n_frames = reader.info().animation_control().unwrap().num_frames;
    let mut screen = vec![[0; 3]; width * height];
    let mut delays = Vec::new();
    for _ in 0..n_frames {
        let mut rgba = vec![0; reader.output_buffer_size().unwrap()];
        let frame = reader.next_frame(&mut rgba).unwrap();
        let control = *reader.info().frame_control().unwrap();
        assert_eq!(control.delay_den, 100);
        delays.push(control.delay_num);
        for (i, pixel) in rgba
            .chunks_exact(4)
            .take((frame.width * frame.height) as usize)
            .enumerate()
        {
            let (row, column) = (i / frame.width as usize, i % frame.width as usize);
            if pixel[3] > 0 {
                let at =
                    (control.y_offset as usize + row) * width + control.x_offset as usize + column;
                screen[at] = [pixel[0], pixel[1], pixel[2]];
            }
        }
    }
    (delays, screen)
}

#[test]
fn both_formats_play_the_same_film() {
    let scenario = street();
    let (log, swerve) = (log_as_rollout(&scenario), swerving(&scenario));
    for theme in [Theme::Light, Theme::Dark] {
        let mut spec = FilmSpec::new(camera(&scenario));
        spec.theme = theme;
        let film = overlay_film(&[&log, &swerve], &spec).unwrap();
        assert_eq!(play(&film.gif), play_apng(&film.to_apng().unwrap()));
    }
    let film = overlay_film(&[&log], &FilmSpec::new(camera(&scenario))).unwrap();
    let folder = tempfile::tempdir().unwrap();
    for (name, start) in [
        ("film.gif", &b"GIF89a"[..]),
        ("film.png", b"\x89PNG"),
        ("film.apng", b"\x89PNG"),
    ] {
        let path = folder.path().join(name);
        film.save(&path).unwrap();
        assert!(std::fs::read(&path).unwrap().starts_with(start), "{name}");
    }
}

#[test]
fn a_camera_that_goes_along_keeps_the_ego_in_the_middle() {
    let scenario = street();
    let log = log_as_rollout(&scenario);
    let fixed = FilmSpec {
        past_s: 0.0,
        ..FilmSpec::new(camera(&scenario))
    };
    let follow = FilmSpec {
        follow: true,
        ..fixed.clone()
    };
    let ego = Theme::Light.colours().ego;
    for (spec, stays) in [(&fixed, false), (&follow, true)] {
        let film = overlay_film(&[&log], spec).unwrap();
        let (_, screen) = play(&film.gif);
        let (width, height) = (
            spec.camera.width_px as usize,
            spec.camera.height_px as usize,
        );
        assert_eq!(screen[height / 2 * width + width / 2] == ego, stays);
    }
}

#[test]
fn a_film_frames_who_moves_and_follows_whom_it_cannot_frame() {
    let scenario = street();
    let log = log_as_rollout(&scenario);
    let framed = FilmSpec::of_rollouts(&[&log], (200, 200));
    assert!(!framed.follow);
    let seen = |point| {
        let pixel = framed.camera.pixel(point);
        (0.0..200.0).contains(&pixel.x) && (0.0..200.0).contains(&pixel.y)
    };
    for frame in std::iter::once(log.start()).chain(log.imagined()) {
        assert!(seen(frame.agent(log.ego()).unwrap().state.pose.position));
    }
    // At 40 m/s no path of 8 s fits into the frame.
    let fast = fixture::scenario(
        "lane 1: 0,0 600,0\nego vehicle 0: 0,0 velocity 40,0\nhistory 1 future 8 dt 0.1",
    )
    .unwrap();
    let spec = FilmSpec::of_rollouts(&[&log_as_rollout(&fast)], (200, 200));
    assert!(spec.follow && spec.camera.metres < 110.0);
}

#[test]
fn a_camera_goes_back_to_the_start_when_the_ego_leaves_the_map() {
    let scenario = fixture::scenario(
        "lane 1: -50,0 60,0\nego vehicle 0: 0,0 velocity 20,0\nhistory 1 future 8 dt 0.1",
    )
    .unwrap();
    let log = log_as_rollout(&scenario);
    let spec = FilmSpec::framing(&[&log], (100, 100));
    assert!(spec.camera.metres < 110.0, "{}", spec.camera.metres);
    let at = |step| {
        let camera = FilmSpec::following((100, 100)).camera.with_ego(&log, step);
        camera.world_from_camera.position.x
    };
    assert_eq!((at(0), at(10)), (0.0, 20.0));
    // It is farther than 25 m beyond the end of its lane after 4.25 s.
    assert!((at(42) - 84.0).abs() < 1e-9, "{}", at(42));
    assert_eq!((at(43), at(80)), (0.0, 0.0));
}

#[test]
fn a_video_is_written_by_ffmpeg_or_refused() {
    let scenario = street();
    let log = log_as_rollout(&scenario);
    let film = overlay_film(&[&log], &FilmSpec::new(camera(&scenario))).unwrap();
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("film.mp4");
    let saved = film.save(&path);
    if crate::can_encode_mp4() {
        saved.unwrap();
        assert_eq!(&std::fs::read(&path).unwrap()[4..8], b"ftyp");
    } else {
        eprintln!("SKIPPED: writing a video wants ffmpeg on the path");
        assert!(matches!(saved, Err(VizError::NoFfmpeg)));
    }
    let n_files = std::fs::read_dir(folder.path()).unwrap().count();
    assert_eq!(
        n_files,
        usize::from(path.is_file()),
        "nothing is left beside it"
    );
}

#[test]
fn candidates_are_drawn_with_the_chosen_one_on_top() {
    let scenario = street();
    let scene = scenario.present();
    let line = |name: &str, y: f64, is_chosen| CandidatePath {
        name: name.into(),
        score: Some(0.5),
        parts: Vec::new(),
        is_chosen,
        path: vec![dvec2(0.0, 0.0), dvec2(8.0, y)],
    };
    let spec = PictureSpec {
        scale_bar: false,
        past_s: 0.0,
        ..PictureSpec::new(camera(&scenario))
    };
    let paths = [
        line("a", 0.0, true),
        line("b", 0.0, false),
        line("c", 4.0, false),
    ];
    let picture = draw_candidates(&scene, &paths, &spec);
    let colour = |x, y| {
        let at = spec.camera.pixel(dvec2(x, y));
        let start = (at.y as usize * picture.width + at.x as usize) * 4;
        [0, 1, 2].map(|i| picture.rgba[start + i])
    };
    let bare = draw_candidates(&scene, &[], &spec);
    assert_eq!(colour(8.0, 0.0), Theme::Light.colours().ego);
    assert_ne!(colour(8.0, 4.0), Theme::Light.colours().ego);
    assert_ne!(picture, bare);
}

#[test]
fn films_that_cannot_be_are_refused() {
    let scenario = street();
    let log = log_as_rollout(&scenario);
    let mut spec = FilmSpec::new(camera(&scenario));
    assert!(matches!(
        grid_film(&[], &spec),
        Err(VizError::NothingToFilm)
    ));
    assert!(matches!(
        overlay_film(&[], &spec),
        Err(VizError::NothingToFilm)
    ));
    spec.camera.width_px = 70_000;
    let too_wide = overlay_film(&[&log], &spec);
    assert!(matches!(
        too_wide,
        Err(VizError::Size { width: 70_000, .. })
    ));
    spec.camera.width_px = 0;
    assert!(matches!(
        overlay_film(&[&log], &spec),
        Err(VizError::Size { .. })
    ));
}

#[test]
fn an_overlay_is_solid_where_futures_agree() {
    let scenario = street();
    let (log, swerve) = (log_as_rollout(&scenario), swerving(&scenario));
    let futures: Vec<&Rollout> = (0..8).map(|i| if i < 4 { &log } else { &swerve }).collect();
    let spec = FilmSpec::new(camera(&scenario));
    let film = overlay_film(&futures, &spec).unwrap();
    let (_, screen) = play(&film.gif);
    let shade = |x, y| {
        let at = spec.camera.pixel(dvec2(x, y));
        screen[at.y as usize * film.width + at.x as usize]
    };
    let away = |rgb: Rgb, from: Rgb| (0..3).map(|i| rgb[i].abs_diff(from[i]) as u32).sum::<u32>();
    let colours = Theme::Light.colours();
    // The other car ends where every future has it; the egos are in two places.
    assert!(away(shade(4.0, 4.0), colours.vehicle) < 60);
    assert!(away(shade(10.0, 0.0), colours.ego) > away(shade(4.0, 4.0), colours.vehicle));
}

fn full_page() -> Page {
    let scenario = street();
    let scene = scenario.present();
    let spec = PictureSpec::new(camera(&scenario));
    let light = draw_scene(&scene, &spec);
    let dark = draw_scene(&scene, &spec.with_theme(Theme::Dark));
    let log = log_as_rollout(&scenario);
    let film = overlay_film(&[&log], &FilmSpec::new(camera(&scenario))).unwrap();
    let chart = Chart {
        title: "Loss".into(),
        series: vec![Series {
            name: "a<b".into(),
            points: vec![(0.0, 1.0), (1.0, 0.5)],
            ..Series::default()
        }],
        ..Chart::default()
    };
    let pair = |a: &str, b: &str| (a.to_string(), b.to_string());
    let mut page = Page::new("Cars & <people>");
    page.lede("\"Quoted\" & more").footer("seed 0 <made here>");
    page.section("One")
        .prose("1 < 2")
        .stats(&[pair("3 %", "collisions")]);
    page.section("Two")
        .key_values(&[pair("model", "tiny'")])
        .preformatted("a  <b>");
    page.section("Three")
        .table(
            &["who", "score"],
            &[
                vec!["idm".into(), "0.5".into()],
                vec!["us".into(), "-".into()],
            ],
        )
        .picture(&light, "still \"life\"")
        .unwrap()
        .themed_picture(&light, &dark, "both")
        .unwrap()
        .gallery(&[
            (light.clone(), "left".into()),
            (dark.clone(), String::new()),
        ])
        .unwrap()
        .chart(&chart, "curve")
        .unwrap()
        .film(&film, "moving");
    page
}

#[test]
fn a_page_is_well_formed_and_stands_alone() {
    let html = full_page().to_html();
    let mut open = Vec::new();
    let (before, style) = html.split_once("<style>").unwrap();
    let (_, after) = style.split_once("</style>").unwrap();
    for part in format!("{before}{after}").split('<').skip(1) {
        let (tag, _) = part.split_once('>').expect("every tag is closed");
        let name = tag.split([' ', '/']).find(|w| !w.is_empty()).unwrap();
        if tag.starts_with('/') {
            assert_eq!(
                open.pop().as_deref(),
                Some(name),
                "</{name}> closes something else"
            );
        } else if !tag.ends_with('/') && !["!doctype", "meta", "img", "source"].contains(&name) {
            open.push(name.to_string());
        }
    }
    assert!(open.is_empty(), "left open: {open:?}");
    for address in ["http", "//cdn", "url(", "@import", "<script", "<link"] {
        assert!(!html.contains(address), "{address} leads outside");
    }
}

#[test]
fn pages_escape_text_and_embed_files() {
    let html = full_page().to_html();
    for text in [
        "<title>Cars &amp; &lt;people&gt;</title>",
        "&quot;Quoted&quot; &amp; more",
        "<p>1 &lt; 2</p>",
        "<dd>tiny&#39;</dd>",
        "a  &lt;b&gt;</pre>",
        "alt=\"still &quot;life&quot;\"",
        "<td class=\"number\">0.5</td>",
        "<td>idm</td>",
        "<a href=\"#s3\">Three</a>",
        "a&lt;b",
    ] {
        assert!(html.contains(text), "{text} is missing");
    }
    assert_eq!(html.matches("data:image/png;base64,iVBOR").count(), 5);
    assert_eq!(html.matches("data:image/gif;base64,R0lGOD").count(), 1);
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("index.html");
    full_page().save(&path).unwrap();
    assert_eq!(std::fs::read_to_string(&path).unwrap(), html);
}
