//! The viewer in a real browser without a window, if there is one on the path.
//!
//! Opened with `#check` the page tries itself (`viewer/check.js`) and reports into the document,
//! which the browser prints.

use std::io::Write as _;
use std::path::{Path, PathBuf};
use std::process::Command;

use gump_geometry::{dvec2, wrap_angle};
use gump_scene::{AgentId, AgentState, Frame, Rollout, Scenario, fixture};
use gump_viz::{CandidatePath, Gallery, HeatMap, MetricTrack, Viewer};
use serde_json::Value;

const BROWSERS: [&str; 5] = [
    "chromium",
    "chromium-browser",
    "google-chrome",
    "google-chrome-stable",
    "chrome",
];

fn browser() -> Option<PathBuf> {
    let path = std::env::var_os("PATH")?;
    let folders: Vec<_> = std::env::split_paths(&path).collect();
    BROWSERS
        .iter()
        .flat_map(|name| folders.iter().map(move |folder| folder.join(name)))
        .find(|file| file.is_file())
}

fn scenario() -> Scenario {
    fixture::scenario(
        "lane 1: -80,0 80,0 next 2
         lane 2: 80,0 160,0
         edge: -80,-2 160,-2
         line: -80,2 160,2
         drivable: -80,-2 160,-2 160,6 -80,6
         crosswalk: 34,-2 38,-2 38,6 34,6
         light 1 red: 30,0
         route 1,2
         ego vehicle 0: 10,0 velocity 8,0
         agent pedestrian 7: 40,3 velocity 0,-1
         agent bicycle 8: 5,-1 velocity 3,0
         agent vehicle 9: 60,3.5 velocity -9,0
         history 1 future 4 dt 0.1",
    )
    .expect("a scene in the language of the fixture")
}

/// A scene to choose beside it.
fn other() -> Scenario {
    let scene = fixture::scenario(
        "lane 1: 0,0 100,0
         ego vehicle 0: 10,0 velocity 8,0
         history 1 future 2 dt 0.1",
    );
    let mut scenario = scene.expect("a scene in the language of the fixture");
    scenario.id = "another scene".into();
    scenario
}

/// Checks the gaps that the ruler shows against those of boxes along the x axis.
fn check_ruler(report: &Value, scenario: &Scenario) {
    let agent = |id| {
        let found = scenario.log[scenario.now].agent(AgentId(id));
        *found.expect("an agent of the scene")
    };
    let (ego, other) = (agent(0), agent(9));
    let between = other.state.pose.position - ego.state.pose.position;
    let sides = dvec2(ego.length + other.length, ego.width + other.width) / 2.0;
    let gap = (between.abs() - sides).max(dvec2(0.0, 0.0)).length();
    let expected = format!(
        "ego, vehicle 0 to vehicle 9: gap {gap:.2} m, centres {:.2} m",
        between.length()
    );
    assert_eq!(report["agents"], expected);
    assert_eq!(report["taps"], expected);
    let address = report["address"].as_str().expect("a text");
    assert!(address.ends_with("ruler=0%2C9"), "{address}");
    let later = report["later"].as_str().expect("a text");
    assert!(later.contains("gap") && later != expected, "{later}");
    let starts = |key: &str, with: &str| report[key].as_str().is_some_and(|t| t.starts_with(with));
    assert!(starts("asks", "Drag") && starts("half", "Now"), "{report}");
    let places = report["places"].as_str().expect("a text");
    let metres: f64 = places.trim_end_matches(" m").parse().expect("metres");
    assert!((metres - 10.0).abs() < 0.3, "{places}");
    assert_eq!(
        (&report["cleared"], &report["drawn"], &report["still"]),
        (&"".into(), &true.into(), &true.into())
    );
}

/// The second scene, by the list, the first, the second and the first again.
fn check_scenes(report: &Value, first: &Scenario, second: &Scenario) {
    let [first, second] = [(first, 4), (second, 1)]
        .map(|(scenario, n_agents)| serde_json::json!([scenario.id, n_agents, scenario.id]));
    let names = serde_json::json!([second, first, second, first]);
    assert_eq!(report["names"], names);
    assert_eq!(
        (&report["listed"], &report["pressed"]),
        (&2.into(), &1.into())
    );
    let address = report["address"].as_str().expect("a text");
    assert!(address.starts_with("scene="), "{address}");
}

/// Futures in which all agents turn, differently in each.
fn futures(scenario: &Scenario, n: usize) -> Vec<Rollout> {
    let turned = |k: usize| {
        let mut rollout = Rollout::begin(scenario.present());
        for step in 1..=40 {
            let agents = rollout.start().agents().iter().map(|agent| {
                let turn = 0.01 * (k as f64 - 1.5) * f64::from(step);
                let mut state: AgentState = agent.state;
                let along = state.velocity * 0.1 * f64::from(step);
                state.pose.position += dvec2(turn.cos(), turn.sin()).rotate(along);
                state.pose.heading = wrap_angle(state.pose.heading + 2.0 * turn);
                agent.with_state(state)
            });
            let frame = Frame::new(agents.collect(), rollout.start().lights().to_vec());
            rollout.push(frame);
        }
        rollout
    };
    (0..n).map(turned).collect()
}

/// Report of the page at `path` about itself, in a window of a size and a dark or light theme.
fn report(browser: &Path, path: &Path, profile: &Path, size: &str, dark: bool) -> Value {
    let scheme = if dark { 0 } else { 1 };
    let output = Command::new(browser)
        .args(["--headless", "--no-sandbox", "--disable-gpu", "--dump-dom"])
        .args(["--enable-logging=stderr", "--virtual-time-budget=20000"])
        .arg(format!("--user-data-dir={}", profile.display()))
        .arg(format!("--window-size={size}"))
        .arg(format!("--blink-settings=preferredColorScheme={scheme}"))
        .arg(format!("file://{}#check", path.display()))
        .output()
        .expect("the browser was found on the path");
    let (dom, log) = (
        String::from_utf8_lossy(&output.stdout),
        String::from_utf8_lossy(&output.stderr),
    );
    let messages: Vec<_> = log
        .lines()
        .filter(|line| line.contains("CONSOLE"))
        .collect();
    assert!(messages.is_empty(), "{messages:#?}");
    let text = dom
        .split_once("<pre id=\"report\">")
        .and_then(|(_, rest)| rest.split_once("</pre>"))
        .map_or_else(
            || panic!("the page did not report: {log}"),
            |(text, _)| text,
        );
    let text = text
        .replace("&gt;", ">")
        .replace("&lt;", "<")
        .replace("&amp;", "&");
    serde_json::from_str(&text).expect("the page reports JSON")
}

#[test]
fn the_viewer_plays_and_switches_in_a_browser() {
    let Some(browser) = browser() else {
        // Past the capture of output, so that it is seen without a flag.
        let written = writeln!(
            std::io::stderr(),
            "SKIPPED, the viewer was not tried: no browser on the path, looked for {BROWSERS:?}"
        );
        written.expect("standard error can be written to");
        return;
    };
    let scenario = scenario();
    let futures = futures(&scenario, 4);
    let mut viewer = Viewer::new(&scenario);
    viewer.futures(&futures[..3]);
    viewer.future("slow ahead", &futures[3]);
    viewer.metric(MetricTrack {
        name: "time to collision, s".into(),
        agent: scenario.ego,
        future: Some(0),
        first: 1,
        values: (0..40).map(|i| (i > 9).then_some(f64::from(i))).collect(),
    });
    let draw = |k: usize| {
        let mut draw = scenario.present().ego_now().state;
        draw.pose.position += dvec2(4.0 + 0.05 * (k % 16) as f64, 0.1 * (k % 5) as f64);
        draw.pose.heading += 0.02 * (k % 7) as f64;
        draw
    };
    viewer.heat(HeatMap {
        agent: scenario.ego,
        future: 0,
        from_s: 0.0,
        ahead_s: 0.5,
        draws: (0..64).map(draw).collect(),
    });
    for (id, plausibility) in [(0, 0.9), (7, 0.4), (9, 0.1)] {
        viewer.plausibility(AgentId(id), plausibility);
    }
    for (name, score) in [("slow ahead", Some(0.25)), ("fast", None)] {
        viewer.candidate(CandidatePath {
            name: name.into(),
            score,
            parts: vec![("progress".into(), 0.25), ("comfort".into(), 1.0)],
            is_chosen: score.is_some(),
            path: vec![dvec2(10.0, 0.0), dvec2(30.0, 1.0)],
        });
    }
    let folder = tempfile::tempdir().expect("a temporary folder");
    let path = folder.path().join("viewer.html");
    let other = other();
    let mut gallery = Gallery::default();
    gallery.add(&viewer).add(&Viewer::new(&other));
    gallery.save(&path).expect("a file can be written there");
    let windows = ["1280,800", "390,844"].map(|size| [false, true].map(|dark| (size, dark)));
    for (size, dark) in windows.into_iter().flatten() {
        let profile = folder.path().join(format!("{size} {dark}"));
        let report = report(&browser, &path, &profile, size, dark);
        eprintln!("{size}: {report}");
        assert_eq!(report["dark"], dark);
        assert_eq!(report["errors"], serde_json::json!([]), "{report}");
        assert!(report.get("error").is_none(), "{report}");
        assert_eq!(report["inflates_alike"], true);
        assert_eq!(
            (&report["takes"], &report["agents"]),
            (&5.into(), &4.into())
        );
        assert_eq!(report["different_takes"], 5);
        let played = report["played_s"].as_f64().unwrap_or_default();
        // Thirty sixtieths of a second, and the frames that the browser drew in between.
        assert!((0.499..0.9).contains(&played), "{played}");
        let changes = report["changes"].as_object().expect("a table of keys");
        assert!(
            changes.len() == 11 && changes.values().all(|changed| *changed == true),
            "{report}"
        );
        assert_eq!(report["overlay_fits_its_pane"], true);
        let heat = report["heat"].as_array().expect("a number per canvas");
        let is_drawn = |inked: &Value| inked.as_u64().is_some_and(|n| n > 100);
        assert!(heat.len() == 3 && heat.iter().all(is_drawn), "{report}");
        assert_eq!(
            (&report["heat_on_road"], &report["heat_elsewhere"]),
            (&true.into(), &false.into())
        );
        let colours = serde_json::json!([["class", "speed", "plausibility"], 3]);
        assert_eq!(report["colours"], colours);
        // Speed, heading, distance from the log and the metric given.
        assert_eq!(
            (&report["charts"], &report["candidates"]),
            (&4.into(), &2.into())
        );
        // A candidate brings its future along.
        let shown = serde_json::json!([0, 4, "Futures: slow ahead"]);
        assert_eq!(report["candidate_shows"], shown);
        // The panel shows the terms of its score and the marks drawn, and the text of the tip of an
        // agent beside it.
        assert_eq!(
            report["parts"],
            serde_json::json!(["progress 0.250", "comfort 1.000"])
        );
        assert!(
            report["marks"].as_u64().is_some_and(|n| n >= 10),
            "{report}"
        );
        let tip = report["tip"].as_str().expect("a text");
        assert!(
            tip.contains("ego, vehicle 0") && tip.contains("m/s"),
            "{tip}"
        );
        let address = report["address"].as_str().expect("a text");
        assert!(
            ["t=1.5", "agent=0", "candidate=1"]
                .iter()
                .all(|part| address.contains(part)),
            "{address}"
        );
        assert_eq!(report["panel_in_sight"], true, "{report}");
        check_ruler(&report["ruler"], &scenario);
        check_scenes(&report["scenes"], &scenario, &other);
        assert_eq!(report["wide"], false, "the page is wider than its window");
        let ends = report["ends"].as_array().expect("one state per take");
        let last = std::iter::once(&scenario.log[scenario.log.len() - 1])
            .chain(futures.iter().map(|future| &future.imagined()[39]));
        for (end, frame) in ends.iter().zip(last) {
            let ego = frame.agent(scenario.ego).expect("the ego stays").state;
            let number = |i: usize| end[i].as_f64().expect("a number");
            assert!((number(0) - ego.pose.position.x).abs() < 0.006, "{end}");
            assert!((number(1) - ego.pose.position.y).abs() < 0.006, "{end}");
            assert!(
                wrap_angle(number(2) - ego.pose.heading).abs() < 0.0005,
                "{end}"
            );
            assert!((number(3) - ego.speed()).abs() < 0.006, "{end}");
        }
    }
}
