//! Tables of targets: what a set of scenes is like, in numbers alone.
//!
//! A recording whose licence forbids to pass it on can be measured once; the table of its
//! distributions is then enough to compare any set with it.

use std::io::Write as _;
use std::path::Path;

use anyhow::Context as _;
use gump_metrics::statistics::{
    Distribution, MeasuredDistribution, Statistic, Statistics, class_name, class_of_name,
};
use serde::{Deserialize, Serialize};

/// The file: how many scenes were measured, then one entry per measure and class.
#[derive(Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Targets {
    /// Source of the numbers.
    provenance: String,
    scenes: u64,
    #[serde(rename = "distribution")]
    distributions: Vec<Target>,
}

/// One distribution.
#[derive(Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Target {
    measure: String,
    class: String,
    mean: f64,
    deviation: f64,
    /// Observations per bin; empty bins at the end are left out.
    counts: Vec<u64>,
}

/// True for a path that names a table rather than scenes.
pub(crate) fn is_table(path: &Path) -> bool {
    path.extension()
        .is_some_and(|extension| extension == "toml")
}

/// Reads a table.
///
/// Error: a file that cannot be read, or an entry that is unknown or does not fit its measure.
pub(crate) fn read(path: &Path) -> anyhow::Result<Statistics> {
    let text =
        std::fs::read_to_string(path).with_context(|| format!("cannot read {}", path.display()))?;
    let table: Targets = toml::from_str(&text)
        .map_err(|error| anyhow::anyhow!("{}: {}", path.display(), error.message()))?;
    let rows = table.distributions.iter().map(|target| {
        let row = parse(target);
        row.map_err(|wrong| anyhow::anyhow!("{}: {wrong}", path.display()))
    });
    let rows = rows.collect::<anyhow::Result<Vec<_>>>()?;
    Ok(Statistics::from_rows(table.scenes, rows))
}

fn parse(
    target: &Target,
) -> Result<
    (
        Statistic,
        gump_metrics::statistics::StatisticClass,
        Distribution,
    ),
    String,
> {
    let Target {
        measure: name,
        class,
        ..
    } = target;
    let measure = Statistic::of_name(name)
        .ok_or_else(|| format!("expected the name of a measure, found {name:?}"))?;
    let class = class_of_name(class).ok_or_else(|| {
        format!("expected scene, vehicle, pedestrian or bicycle, found {class:?}")
    })?;
    let (low, high, bins) = measure.bins();
    let mut counts = target.counts.clone();
    if counts.len() > bins {
        return Err(format!(
            "{name} has {} counts, expected at most {bins}",
            counts.len()
        ));
    }
    counts.resize(bins, 0);
    let distribution = Distribution::from_parts(low, high, counts, target.mean, target.deviation);
    Ok((measure, class, distribution))
}

/// Writes a table, whole or not at all.
///
/// Error: a file that cannot be written.
pub(crate) fn write(path: &Path, provenance: &str, statistics: &Statistics) -> anyhow::Result<()> {
    let table = Targets {
        provenance: provenance.into(),
        scenes: statistics.scenes(),
        distributions: statistics.rows().iter().map(target).collect(),
    };
    let mut text = String::from(
        "# What a set of scenes is like, in numbers alone: `cargo xtask data stats PATH \
         --against THIS_FILE`.\n# Bins are those of `gump_metrics::statistics::Statistic`.\n\n",
    );
    text.push_str(&toml::to_string(&table)?);
    gump_data::write_atomically(path, |file| {
        file.write_all(text.as_bytes())
            .with_context(|| format!("cannot write {}", path.display()))
    })
}

fn target(row: &MeasuredDistribution<'_>) -> Target {
    let counts = row.distribution.counts();
    let used = counts
        .iter()
        .rposition(|&n| n > 0)
        .map_or(0, |last| last + 1);
    let round = |x: f64| (x * 1e6).round() / 1e6;
    Target {
        measure: row.measure.name().into(),
        class: class_name(row.class).into(),
        mean: round(row.distribution.mean()),
        deviation: round(row.distribution.deviation()),
        counts: counts[..used].to_vec(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn statistics() -> Statistics {
        let mut statistics = Statistics::default();
        let text = "lane 1: 0,0 99,0\nego vehicle 0: 0,0 velocity 5,0\nagent pedestrian 1: 9,3";
        statistics.add(&gump_scene::fixture::scenario(text).unwrap());
        statistics
    }

    #[test]
    fn a_table_is_as_good_as_the_scenes() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("targets.toml");
        let before = statistics();
        write(&path, "a test", &before).unwrap();
        let after = read(&path).unwrap();
        assert_eq!(after.scenes(), 1);
        let rows = before.compare(&after);
        assert_eq!(rows.len(), before.rows().len());
        assert!(
            rows.iter()
                .all(|row| row.wasserstein.is_some_and(|d| d < 1e-4))
        );
        assert!(rows.iter().all(|row| {
            row.mean
                .zip(row.reference_mean)
                .is_some_and(|(a, b)| (a - b).abs() < 1e-5)
        }));
    }

    #[test]
    fn a_table_that_does_not_fit_is_told() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("targets.toml");
        let error = |text: &str| {
            std::fs::write(&path, text).unwrap();
            format!("{:#}", read(&path).unwrap_err())
        };
        let head = "provenance = \"\"\nscenes = 1\n[[distribution]]\nmean = 0.0\ndeviation = 0.0\n";
        let wrong = error(&format!(
            "{head}measure = \"sped\"\nclass = \"vehicle\"\ncounts = []"
        ));
        assert!(
            wrong.ends_with("expected the name of a measure, found \"sped\""),
            "{wrong}"
        );
        let wrong = error(&format!(
            "{head}measure = \"standing\"\nclass = \"vehicle\"\ncounts = [1, 2, 3]"
        ));
        assert!(
            wrong.ends_with("standing has 3 counts, expected at most 2"),
            "{wrong}"
        );
        assert!(error("scenes = 1").contains("provenance"));
    }

    #[test]
    fn the_targets_that_are_shipped_can_be_read() {
        let path = crate::machine::repository().join("configs/targets/waymo-like.toml");
        let targets = read(&path).unwrap();
        assert!(targets.scenes() >= 100);
        let standing = targets.get(Statistic::Standing, Some(gump_scene::AgentKind::Vehicle));
        assert!((0.6..0.9).contains(&standing.unwrap().mean()));
    }
}
