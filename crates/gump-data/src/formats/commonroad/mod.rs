//! CommonRoad XML, versions 2018b and 2020a: lanelets, recorded obstacles, a planning problem.
//!
//! The map is in `road`, traffic in `traffic`. The planning problem states where a planner starts,
//! but no track of its vehicle. The ego is therefore the obstacle that starts there if there is
//! one, or else the vehicle observed longest; the report states which.
//!
//! Source: "CommonRoad: XML format", versions 2018b and 2020a, of the Technical University of
//! Munich.

mod road;
mod traffic;

use std::path::Path;

use crate::complete::recording::assemble;
use crate::formats::document::{self, Document};
use crate::io::xml::{self, Element};
use crate::source::Format;
use crate::{DataError, Problem, ReadOptions, ReadReport};

pub(crate) const FORMAT: Format = Format {
    name: "CommonRoad XML 2018b/2020a (plain or gzip)",
    recognises,
    open: document::open::<File>,
};

fn recognises(head: &[u8]) -> bool {
    let text = String::from_utf8_lossy(&head[..head.len().min(4096)]);
    text.trim_start_matches('\u{feff}')
        .trim_start()
        .starts_with('<')
        && text.contains("<commonRoad")
}

/// A parsed file.
pub(crate) struct File(Element);

/// The versions whose elements are understood. 2018a differs from 2018b in nothing that is read.
const VERSIONS: [&str; 3] = ["2018a", "2018b", "2020a"];

impl Document for File {
    const WHAT: &'static str = "a CommonRoad scenario as XML";

    fn read(path: &Path) -> Result<Self, DataError> {
        xml::read(path, Self::WHAT).map(Self)
    }

    fn id(&self, path: &Path) -> String {
        let id = self.0.attribute("benchmarkID").filter(|id| !id.is_empty());
        id.map_or_else(|| document::stem(path), str::to_owned)
    }

    fn scenario(
        self,
        id: String,
        options: ReadOptions,
        report: &mut ReadReport,
    ) -> Result<gump_scene::Scenario, Problem> {
        let root = &self.0;
        let version = root.attribute("commonRoadVersion").unwrap_or("none");
        if &*root.name != "commonRoad" || !VERSIONS.contains(&version) {
            return Err(Problem::Unexpected {
                expected: "CommonRoad version 2018a, 2018b or 2020a",
                found: version.into(),
                place: "the root element".into(),
            });
        }
        let dt: f64 = root
            .attribute("timeStepSize")
            .and_then(|t| t.parse().ok())
            .unwrap_or(f64::NAN);
        if !(dt > 1e-3 && dt < 10.0) {
            return Err(Problem::Unexpected {
                expected: "a time step between 1 ms and 10 s",
                found: root.attribute("timeStepSize").unwrap_or("none").into(),
                place: "timeStepSize of the root element".into(),
            });
        }
        let parts = road::parts(root, options, report);
        if parts.lanes.is_empty() {
            return Err(Problem::NoMap);
        }
        let recording = traffic::recording(root, id, dt, &parts, report);
        assemble(recording, parts, options, report)
    }
}
