//! Flags whose values are the variants of a library's enum: what the help says of each, and their
//! parser.
//!
//! The names are the library's, which also reads them. A verb offers the values of its table, which
//! may be fewer.

use std::fmt::{Debug, Display};
use std::str::FromStr;

use clap::builder::{PossibleValue, PossibleValuesParser, TypedValueParser};
use gump_data::OutputFormat;
use gump_engine::{CacheMode, LightSource, Mode, Precision, Routes};
use gump_generate::Placement;
use gump_nuplan::closed_loop::Tracking;
use gump_planner::{Aggregate, Allocation, WarmStart};
use gump_rl::Algorithm;
use gump_wosac::motion::ShapeRules;
use gump_wosac::realism::Year;

/// Orders of decoding.
pub(crate) const MODES: [(Mode, &str); 2] = [(Mode::PartialAr, ""), (Mode::FullAr, "")];

/// Caches of a network.
pub(crate) const CACHES: [(CacheMode, &str); 3] = [
    (
        CacheMode::None,
        "No key/value cache: every pass recomputes the whole window",
    ),
    (
        CacheMode::Window,
        "Sliding window; nothing is recomputed within a frame",
    ),
    (
        CacheMode::Growing,
        "Growing window, as far as it fits; nothing is recomputed between frames either",
    ),
];

/// Number formats of weights.
pub(crate) const PRECISIONS: [(Precision, &str); 3] = [
    (Precision::F32, ""),
    (Precision::Bf16, ""),
    (Precision::Int8, ""),
];

/// Sources of lights after the present.
pub(crate) const LIGHTS: [(LightSource, &str); 3] = [
    (LightSource::Model, "Simulated signal phases"),
    (LightSource::Hold, "As at the present"),
    (LightSource::Log, "As recorded (uses the future)"),
];

/// When vehicles are given routes.
pub(crate) const ROUTES: [(Routes, &str); 3] = [
    (Routes::Never, "The network decides every half second"),
    (Routes::Late, "After nine seconds"),
    (Routes::Always, "From the second step on"),
];

/// Distributions of rollouts over candidates.
pub(crate) const ALLOCATIONS: [(Allocation, &str); 2] = [
    (Allocation::Uniform, "All futures of all candidates"),
    (
        Allocation::Halving,
        "One future of all candidates, further ones of the better half, and so on",
    ),
];

/// What a decision takes over from the one before it.
pub(crate) const WARM_STARTS: [(WarmStart, &str); 2] = [
    (WarmStart::Off, "Nothing: all candidates are simulated"),
    (
        WarmStart::Rest,
        "Policies that were clearly worse rest for up to three decisions, unless they could win now",
    ),
];

/// Values of a candidate with several futures.
pub(crate) const AGGREGATES: [(Aggregate, &str); 2] = [
    (Aggregate::Mean, "The mean of its futures"),
    (Aggregate::Worst, "The worst of its futures"),
];

/// Controllers of a closed loop; the logged states are for open loops.
pub(crate) const CONTROLLERS: [(Tracking, &str); 2] = [
    (
        Tracking::TwoStage,
        "LQR tracker with a kinematic bicycle model",
    ),
    (Tracking::Perfect, "Perfect tracking of the plan"),
];

/// Definitions of path shapes.
pub(crate) const SHAPES: [(ShapeRules, &str); 2] = [
    (ShapeRules::Current, "Since March 2024"),
    (ShapeRules::Until2023, "Leaderboards of 2021 to 2023"),
];

/// Years of the realism challenge.
pub(crate) const YEARS: [(Year, &str); 5] = [
    (Year::Y2023V0, "As first published: leaderboard V0"),
    (Year::Y2023, "Leaderboard V1"),
    (Year::Y2024, ""),
    (Year::Y2025, "Simulated agents"),
    (Year::Y2025Generation, "Scenario generation"),
];

/// Places of generated objects.
pub(crate) const PLACEMENTS: [(Placement, &str); 2] = [
    (Placement::Free, "Wherever the model puts them"),
    (
        Placement::Guided,
        "Only the model's proposals on lanes and walkways",
    ),
];

/// Algorithms of reinforcement learning.
pub(crate) const ALGORITHMS: [(Algorithm, &str); 3] = [
    (
        Algorithm::Sac,
        "Soft actor-critic: rewards, and a share of expert transitions",
    ),
    (
        Algorithm::Ppo,
        "Proximal policy optimization: imitation, then rewards; many steps of the world",
    ),
    (Algorithm::Imitation, "Imitation of the log's actions"),
];

/// Formats to convert to.
pub(crate) const FORMATS: [(OutputFormat, &str); 4] = [
    (OutputFormat::Cache, "The cache, which training reads from"),
    (OutputFormat::Waymo, "Waymo's scenarios as TFRecord"),
    (OutputFormat::ScenarioJson, "JSON, a file per scenario"),
    (OutputFormat::Parquet, "Tables of tracks"),
];

/// The parser of a table above; without a text, the help lists the name alone.
pub(crate) fn one_of<T, const N: usize>(
    table: [(T, &'static str); N],
) -> impl TypedValueParser<Value = T>
where
    T: Clone + Display + FromStr + Send + Sync + 'static,
    T::Err: Debug,
{
    let listed = table.map(|(value, help)| {
        let value = PossibleValue::new(value.to_string());
        match help {
            "" => value,
            help => value.help(help),
        }
    });
    named(listed)
}

/// The parser of names that the value's type reads.
pub(crate) fn named<T>(names: impl Into<PossibleValuesParser>) -> impl TypedValueParser<Value = T>
where
    T: Clone + FromStr + Send + Sync + 'static,
    T::Err: Debug,
{
    let read = |name: String| name.parse().expect("the library reads the names it lists");
    names.into().map(read)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn check<T>(table: &[(T, &str)], all: &[T])
    where
        T: Clone + Debug + Display + FromStr + PartialEq,
        T::Err: Debug,
    {
        let listed: Vec<T> = table.iter().map(|(value, _)| value.clone()).collect();
        assert_eq!(listed, all);
        for value in all {
            assert_eq!(value.to_string().parse::<T>().unwrap(), *value);
        }
    }

    #[test]
    fn tables_have_all_values() {
        check(&MODES, &Mode::ALL);
        check(&CACHES, &CacheMode::ALL);
        check(&PRECISIONS, &Precision::ALL);
        check(&LIGHTS, &LightSource::ALL);
        check(&ROUTES, &Routes::ALL);
        check(&ALLOCATIONS, &Allocation::ALL);
        check(&WARM_STARTS, &WarmStart::ALL);
        check(&AGGREGATES, &Aggregate::ALL);
        check(&CONTROLLERS, &[Tracking::TwoStage, Tracking::Perfect]);
        check(&SHAPES, &ShapeRules::ALL);
        check(&YEARS, &Year::ALL);
        check(&PLACEMENTS, &Placement::ALL);
        check(&ALGORITHMS, &Algorithm::ALL);
        check(&FORMATS, OutputFormat::ALL);
    }
}
