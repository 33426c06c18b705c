//! Scenes in one page: the template, its scripts and a block of data for each scene.

use std::fmt::Write as _;
use std::io::Write as _;
use std::path::Path;

use base64::Engine;
use base64::engine::general_purpose::STANDARD as BASE64;
use flate2::Compression;
use flate2::write::DeflateEncoder;

use super::Viewer;
use crate::VizError;
use crate::files::write_whole;
use crate::page::escape;

/// Scenes in one viewer: an HTML file with a list of scenes to choose from.
///
/// A scene is packed when it is added, a few hundred kilobytes for 32 futures, and need not be
/// kept; the page unpacks it when it is chosen. The page's address names the scene by its id, or
/// by its number from 1 where an id repeats.
///
/// ```no_run
/// # fn page(scenarios: &[gump_scene::Scenario]) -> Result<(), gump_viz::VizError> {
/// let mut gallery = gump_viz::Gallery::default();
/// for scenario in scenarios {
///     gallery.add(&gump_viz::Viewer::new(scenario));
/// }
/// gallery.save("scenes.html".as_ref())
/// # }
/// ```
#[derive(Clone, Debug, Default)]
pub struct Gallery {
    scenes: Vec<Packed>,
}

/// A scene as the page holds it.
#[derive(Clone, Debug)]
struct Packed {
    id: String,
    /// Description of the scene, as JSON without "<".
    facts: String,
    /// Road and traffic, deflated, as base64.
    data: String,
}

impl Gallery {
    /// Adds a scene after those that are there.
    pub fn add(&mut self, viewer: &Viewer<'_>) -> &mut Self {
        let (facts, bytes) = viewer.pack();
        self.scenes.push(Packed {
            id: viewer.scenario.id.clone(),
            // Inside a script nothing but "<" could end it; JSON may write it as an escape anywhere.
            facts: facts.to_string().replace('<', "\\u003c"),
            data: BASE64.encode(deflate(&bytes)),
        });
        self
    }

    /// Number of scenes.
    pub fn len(&self) -> usize {
        self.scenes.len()
    }

    /// Whether there is no scene yet.
    pub fn is_empty(&self) -> bool {
        self.scenes.is_empty()
    }

    /// The whole page; it refers to nothing outside itself. Without scenes it has nothing to show.
    pub fn to_html(&self) -> String {
        let parts = [
            ("title", escape(&self.title())),
            ("palette", include_str!("../palette.css").to_owned()),
            ("style", include_str!("viewer.css").to_owned()),
            ("scenes", self.blocks()),
            ("traffic", script(include_str!("../traffic.js"))),
            ("unpack", include_str!("unpack.js").to_owned()),
            ("draw", include_str!("draw.js").to_owned()),
            ("heat", include_str!("heat.js").to_owned()),
            ("chart", include_str!("chart.js").to_owned()),
            ("ruler", include_str!("ruler.js").to_owned()),
            ("app", include_str!("app.js").to_owned()),
            ("check", include_str!("check.js").to_owned()),
        ];
        fill(include_str!("viewer.html"), &parts)
    }

    /// Writes the page; a reader finds the old file or the new one, never half of one.
    ///
    /// # Errors
    /// [`VizError::Write`] with the path.
    pub fn save(&self, path: &Path) -> Result<(), VizError> {
        write_whole(path, self.to_html().as_bytes())
    }

    fn title(&self) -> String {
        match &self.scenes[..] {
            [scene] => scene.id.clone(),
            scenes => format!("{} scenes", scenes.len()),
        }
    }

    /// Two elements for each scene: its description, then its bytes.
    fn blocks(&self) -> String {
        let mut blocks = String::new();
        for (i, scene) in self.scenes.iter().enumerate() {
            let number = match i {
                0 => String::new(),
                _ => format!("-{}", i + 1),
            };
            let Packed { facts, data, .. } = scene;
            writeln!(
                blocks,
                "<script type=\"application/json\" id=\"facts{number}\">{facts}</script>\n\
                 <script type=\"text/plain\" id=\"data{number}\">{data}</script>"
            )
            .expect("writing to a string cannot fail");
        }
        blocks
    }
}

/// A module as plain script: what it exports is there for the scripts after it.
fn script(module: &str) -> String {
    module.replace("\nexport ", "\n")
}

fn deflate(bytes: &[u8]) -> Vec<u8> {
    let mut encoder = DeflateEncoder::new(Vec::new(), Compression::best());
    let written = encoder.write_all(bytes).and_then(|()| encoder.finish());
    written.expect("writing to memory cannot fail")
}

/// Replaces each `@@name@@` of the template with the part of that name; parts are not expanded.
fn fill(template: &str, parts: &[(&str, String)]) -> String {
    let pieces = template.split("@@").enumerate().map(|(i, piece)| {
        if i % 2 == 0 {
            return piece;
        }
        let part = parts.iter().find(|(name, _)| *name == piece);
        part.expect("the template names only parts there are")
            .1
            .as_str()
    });
    pieces.collect()
}
