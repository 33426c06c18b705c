//! Statistics of traffic as distributions, collected over any number of scenes in constant memory
//! and compared with those of other scenes.
//!
//! Start with [`Statistics::add`] and [`Statistics::compare`]; [`Statistic::ALL`] lists the
//! measures. A measure is counted for vehicles, pedestrians and bicycles separately, or once per
//! scene. Every distribution has fixed bins, so that partial counts can be added and two sets can be
//! compared without their scenes.
//!
//! ```
//! use gump_metrics::statistics::{Statistic, Statistics};
//!
//! let scenario = gump_scene::fixture::scenario(
//!     "lane 1: 0,0 200,0
//!      ego vehicle 0: 10,0 velocity 8,0
//!      agent vehicle 1: 40,5",
//! ).unwrap();
//! let mut statistics = Statistics::default();
//! statistics.add(&scenario);
//! let rows = statistics.rows();
//! let standing = rows.iter().find(|row| row.measure == Statistic::Standing).unwrap();
//! assert_eq!(standing.distribution.mean(), 0.5);
//! assert!(statistics.compare(&statistics).iter().all(|row| row.wasserstein == Some(0.0)));
//! ```

mod distribution;
mod measure;
mod observe;
mod surroundings;

use std::collections::BTreeMap;

use gump_scene::{AgentKind, Scenario};

pub use self::distribution::Distribution;
pub use self::measure::Statistic;

/// The class that a measure is counted for: a kind of agent, or `None` for the scene as a whole.
pub type StatisticClass = Option<AgentKind>;

/// The name of a class in tables.
pub fn class_name(class: StatisticClass) -> &'static str {
    class.map_or("scene", AgentKind::name)
}

/// The class with this name in tables.
pub fn class_of_name(name: &str) -> Option<StatisticClass> {
    let kinds = AgentKind::MOVING.into_iter().map(Some);
    let mut all = std::iter::once(None).chain(kinds);
    all.find(|class| class_name(*class) == name)
}

/// Distributions of every measure over some scenes.
#[derive(Clone, Debug, Default)]
pub struct Statistics {
    scenes: u64,
    counted: BTreeMap<(Statistic, StatisticClass), Distribution>,
}

/// The distribution of a measure over a class of agents.
#[derive(Clone, Debug)]
pub struct MeasuredDistribution<'a> {
    /// The measure.
    pub measure: Statistic,
    /// The class.
    pub class: StatisticClass,
    /// Its values.
    pub distribution: &'a Distribution,
}

/// One distribution compared with that of other scenes.
#[derive(Clone, Debug, PartialEq)]
pub struct Comparison {
    /// The measure.
    pub measure: Statistic,
    /// The class.
    pub class: StatisticClass,
    /// Observations in the set.
    pub n: u64,
    /// Mean of the set; `None` without observations.
    pub mean: Option<f64>,
    /// Observations in the reference.
    pub reference_n: u64,
    /// Mean of the reference.
    pub reference_mean: Option<f64>,
    /// 1-Wasserstein distance in standard deviations of the reference; `None` where either side
    /// has no observation.
    pub wasserstein: Option<f64>,
    /// Jensen-Shannon divergence in bits: 0 for equal, 1 for disjoint distributions.
    pub jensen_shannon: Option<f64>,
}

impl Statistics {
    /// Adds a scene.
    pub fn add(&mut self, scenario: &Scenario) {
        self.scenes += 1;
        observe::observe(scenario, self);
    }

    /// Adds counts from elsewhere.
    pub fn merge(&mut self, other: &Self) {
        self.scenes += other.scenes;
        for (key, distribution) in &other.counted {
            self.of(*key).merge(distribution);
        }
    }

    /// Number of scenes.
    pub fn scenes(&self) -> u64 {
        self.scenes
    }

    /// Statistics of `scenes` scenes from stored distributions.
    pub fn from_rows(
        scenes: u64,
        rows: impl IntoIterator<Item = (Statistic, StatisticClass, Distribution)>,
    ) -> Self {
        let counted = rows.into_iter().map(|(m, c, d)| ((m, c), d)).collect();
        Self { scenes, counted }
    }

    /// All distributions, by measure and class.
    pub fn rows(&self) -> Vec<MeasuredDistribution<'_>> {
        let row = |(&(measure, class), distribution)| MeasuredDistribution {
            measure,
            class,
            distribution,
        };
        self.counted.iter().map(row).collect()
    }

    /// The distribution of a measure; `None` if nothing was observed.
    pub fn get(&self, measure: Statistic, class: StatisticClass) -> Option<&Distribution> {
        self.counted.get(&(measure, class))
    }

    /// Every distribution that either side has, compared with that of the reference.
    pub fn compare(&self, reference: &Self) -> Vec<Comparison> {
        let keys = self.counted.keys().chain(reference.counted.keys());
        let keys: std::collections::BTreeSet<_> = keys.copied().collect();
        let compared = keys.into_iter().map(|(measure, class)| {
            let (own, theirs) = (self.get(measure, class), reference.get(measure, class));
            let both = own.zip(theirs);
            Comparison {
                measure,
                class,
                n: own.map_or(0, Distribution::n),
                mean: own.map(Distribution::mean),
                reference_n: theirs.map_or(0, Distribution::n),
                reference_mean: theirs.map(Distribution::mean),
                wasserstein: both.map(|(own, theirs)| own.wasserstein(theirs)),
                jensen_shannon: both.map(|(own, theirs)| own.jensen_shannon(theirs)),
            }
        });
        compared.collect()
    }

    /// Records an observation.
    fn note(&mut self, measure: Statistic, class: StatisticClass, value: f64) {
        self.of((measure, class)).add(value);
    }

    /// Records whether a condition holds.
    fn note_if(&mut self, measure: Statistic, class: StatisticClass, holds: bool) {
        self.note(measure, class, f64::from(u8::from(holds)));
    }

    fn of(&mut self, key: (Statistic, StatisticClass)) -> &mut Distribution {
        let empty = || {
            let (low, high, bins) = key.0.bins();
            Distribution::new(low, high, bins)
        };
        self.counted.entry(key).or_insert_with(empty)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use Statistic as M;

    const VEHICLE: StatisticClass = Some(AgentKind::Vehicle);

    fn counted(text: &str) -> Statistics {
        let mut statistics = Statistics::default();
        statistics.add(&gump_scene::fixture::scenario(text).unwrap());
        statistics
    }

    fn mean(statistics: &Statistics, measure: Statistic, class: StatisticClass) -> f64 {
        statistics.get(measure, class).unwrap().mean()
    }

    #[test]
    fn a_street_with_a_parked_car_is_told_as_it_is() {
        let statistics = counted(
            "lane 1: 0,0 300,0
             ego vehicle 0: 10,0.5 velocity 8,0
             agent vehicle 1: 30,0.5 velocity 8,0
             agent vehicle 2: 40,4
             agent pedestrian 3: 60,1 velocity 0,-0.4
             history 1 future 2 dt 0.1",
        );
        assert_eq!(statistics.scenes(), 1);
        assert!((mean(&statistics, M::Standing, VEHICLE) - 1.0 / 3.0).abs() < 1e-9);
        assert!((mean(&statistics, M::Parked, VEHICLE) - 1.0 / 3.0).abs() < 1e-9);
        assert_eq!(mean(&statistics, M::ParkedOffLane, VEHICLE), 1.0);
        assert!((mean(&statistics, M::Speed, VEHICLE) - 8.0).abs() < 1e-9);
        // Boxes of 4.5 m, 20 m apart.
        let gap = statistics.get(M::Gap, VEHICLE).unwrap();
        assert!((gap.mean() - 15.5).abs() < 1.0, "{}", gap.mean());
        let headway = statistics.get(M::Headway, VEHICLE).unwrap();
        assert_eq!(headway.n(), gap.n());
        assert!((headway.mean() - gap.mean() / 8.0).abs() < 1e-9);
        assert_eq!(mean(&statistics, M::Crawling, VEHICLE), 0.0);
        assert_eq!(mean(&statistics, M::LateralOffset, VEHICLE), 0.5);
        assert_eq!(mean(&statistics, M::Agents, VEHICLE), 3.0);
        assert_eq!(
            mean(&statistics, M::OnCrosswalk, Some(AgentKind::Pedestrian)),
            0.0
        );
        // Too slow to walk: it moves at 0.4 m/s.
        let people = Some(AgentKind::Pedestrian);
        assert!(statistics.get(M::Company, people).is_none());
        assert_eq!(mean(&statistics, M::Crawling, people), 1.0);
        assert_eq!(mean(&statistics, M::EgoSpeed, None), 8.0);
        assert_eq!(mean(&statistics, M::Lanes, None), 1.0);
        assert_eq!(mean(&statistics, M::Jitter, VEHICLE), 0.0);
    }

    #[test]
    fn what_follows_is_counted_by_the_speed_before() {
        let mut scenario = gump_scene::fixture::scenario(
            "lane 1: 0,0 300,0
             ego vehicle 0: 10,0.5 velocity 15,0
             agent vehicle 1: 30,0.5 velocity 2,0
             agent vehicle 2: 40,4
             history 1 future 5 dt 0.1",
        )
        .unwrap();
        // The ego loses half a metre per second and turns by 0.01 in each tenth of a second.
        for (step, frame) in scenario.log.iter_mut().enumerate() {
            let mut agents = frame.agents().to_vec();
            agents[0].state.velocity.x -= 0.05 * step as f64;
            agents[0].state.pose.heading -= 0.01 * step as f64;
            *frame = gump_scene::Frame::new(agents, Vec::new());
        }
        let mut statistics = Statistics::default();
        statistics.add(&scenario);
        // Six seconds, so that there are changes from three starts; the ego is below 14 m/s after two.
        let n = |measure| statistics.get(measure, VEHICLE).map(Distribution::n);
        assert_eq!(n(M::SpeedChange12To16), Some(3));
        assert_eq!(n(M::SpeedChange1To4), Some(3));
        assert_eq!(n(M::SpeedChange4To8), None);
        let follows = |measure| mean(&statistics, measure, VEHICLE);
        assert!((follows(M::SpeedChange12To16) + 2.0).abs() < 1e-9);
        assert_eq!(follows(M::SpeedChange1To4), 0.0);
        assert!((follows(M::FastTurn) - 0.1).abs() < 1e-9);
    }

    #[test]
    fn people_side_by_side_are_company() {
        let statistics = counted(
            "lane 1: 0,0 300,0
             ego vehicle 0: 10,0.5
             agent pedestrian 1: 60,5 velocity 1.2,0
             agent pedestrian 2: 60,5.7 velocity 1.2,0
             agent pedestrian 3: 90,5 velocity 1.2,0
             history 1 future 2 dt 0.1",
        );
        let company = mean(&statistics, M::Company, Some(AgentKind::Pedestrian));
        assert!(
            (company - (0.7 + 0.7 + 10.0) / 3.0).abs() < 1e-9,
            "{company}"
        );
        assert!(statistics.get(M::Company, VEHICLE).is_none());
    }

    #[test]
    fn parts_add_up_and_rows_are_all_there_is() {
        let texts = [
            "ego vehicle 0: 0,0 velocity 5,0",
            "ego vehicle 0: 0,0\nagent vehicle 1: 9,0 velocity 3,0",
        ];
        let mut whole = Statistics::default();
        let mut merged = Statistics::default();
        for text in texts {
            let scenario = gump_scene::fixture::scenario(text).unwrap();
            whole.add(&scenario);
            merged.merge(&counted(text));
        }
        let rows = |s: &Statistics| {
            let rows = s
                .rows()
                .into_iter()
                .map(|r| (r.measure, r.class, r.distribution.clone()));
            rows.collect::<Vec<_>>()
        };
        assert_eq!(rows(&whole), rows(&merged));
        let again = Statistics::from_rows(2, rows(&whole));
        assert!(
            again
                .compare(&whole)
                .iter()
                .all(|row| row.wasserstein == Some(0.0))
        );
    }

    #[test]
    fn what_only_one_side_has_has_no_distance() {
        let [one, two] = [
            counted("ego vehicle 0: 0,0 velocity 5,0"),
            counted("ego vehicle 0: 0,0 velocity 5,0\nagent pedestrian 1: 9,0"),
        ];
        let rows = one.compare(&two);
        let row = rows
            .iter()
            .find(|row| row.class == Some(AgentKind::Pedestrian) && row.measure == M::Standing)
            .unwrap();
        assert_eq!((row.n, row.mean, row.wasserstein), (0, None, None));
        assert_eq!(row.reference_mean, Some(1.0));
    }

    #[test]
    fn names_are_unique_and_known() {
        for measure in Statistic::ALL {
            assert_eq!(Statistic::of_name(measure.name()), Some(measure));
        }
        for name in ["scene", "vehicle", "pedestrian", "bicycle"] {
            assert_eq!(class_of_name(name).map(class_name), Some(name));
        }
        assert_eq!(class_of_name("cone"), None);
    }
}
