//! Tables of reports as bar charts, which `evaluate` leaves beside its numbers.

use std::path::Path;

use gump_viz::{Bar, BarGroup, Bars, VizError};
use serde_json::Value;

use crate::run::Run;

/// A chart of a table; `cell` returns the bar of a row and a column, if there is one.
pub(crate) fn bars(
    label: &str,
    rows: Vec<String>,
    columns: Vec<String>,
    cell: impl Fn(usize, usize) -> Option<Bar>,
) -> Bars {
    let n = columns.len();
    let groups = rows.into_iter().enumerate().map(|(row, name)| BarGroup {
        name,
        bars: (0..n).map(|column| cell(row, column)).collect(),
    });
    Bars {
        title: String::new(),
        label: label.into(),
        groups: groups.collect(),
        series: columns,
    }
}

/// A number of a report, and its interval where the report has one.
pub(crate) fn bar(value: &Value, low: &Value, high: &Value) -> Option<Bar> {
    Some(Bar {
        value: value.as_f64()?,
        span: low.as_f64().zip(high.as_f64()),
    })
}

/// Name of a world in a legend: of a network, the name of its file without folders.
pub(crate) fn legend(world: &str) -> String {
    match world.strip_prefix("model:") {
        Some(path) => {
            let stem = Path::new(path).file_stem();
            stem.map_or(world, |stem| stem.to_str().unwrap_or(world))
                .to_owned()
        }
        None => world.to_owned(),
    }
}

/// Names of worlds in a legend, whose decoding may follow them in parentheses. A network beside itself
/// decoded otherwise is `(ruled)`.
pub(crate) fn legends(worlds: &[&str]) -> Vec<String> {
    let apart = |world: &str| match world.strip_suffix(')').and_then(|w| w.rsplit_once(" (")) {
        Some((world, decoding)) => (legend(world), Some(decoding.to_owned())),
        None => (legend(world), None),
    };
    let all: Vec<(String, Option<String>)> = worlds.iter().map(|world| apart(world)).collect();
    let name = |(world, decoding): &(String, Option<String>)| match decoding {
        Some(decoding) => format!("{world} ({decoding})"),
        None if all.iter().any(|(w, d)| w == world && d.is_some()) => format!("{world} (ruled)"),
        None => world.clone(),
    };
    all.iter().map(name).collect()
}

/// Writes `STEM.svg` and `STEM.png` into the folder of the run; nothing if there is no number.
pub(crate) fn save(run: &Run, stem: &str, bars: &Bars) -> anyhow::Result<()> {
    match bars.save(&run.path(stem)) {
        Err(VizError::EmptyChart { .. }) => Ok(()),
        saved => Ok(saved?),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    #[test]
    fn cells_become_bars_with_their_intervals() {
        let rows = [
            json!({"a": 0.5, "low": 0.4, "high": 0.7}),
            json!({"a": null}),
        ];
        let names = ["first", "second"].map(String::from).to_vec();
        let chart = bars("score", names, vec!["a".into()], |row, _| {
            let row = &rows[row];
            bar(&row["a"], &row["low"], &row["high"])
        });
        let span = Some((0.4, 0.7));
        assert_eq!(chart.groups[0].bars, [Some(Bar { value: 0.5, span })]);
        assert_eq!(chart.groups[1].bars, [None]);
    }

    #[test]
    fn a_network_is_told_from_itself_without_rules() {
        let tiny = "model:a/gump-tiny.safetensors";
        let raw = format!("{tiny} (raw)");
        let expected = ["gump-tiny (ruled)", "gump-tiny (raw)", "log"];
        assert_eq!(legends(&[tiny, &raw, "log"]), expected);
        assert_eq!(legends(&[tiny, "log"]), ["gump-tiny", "log"]);
        assert_eq!(legends(&[&raw]), ["gump-tiny (raw)"]);
    }

    #[test]
    fn networks_go_by_the_names_of_their_files() {
        assert_eq!(legend("model:a/b/gump-tiny.safetensors"), "gump-tiny");
        assert_eq!(legend("idm"), "idm");
    }
}
