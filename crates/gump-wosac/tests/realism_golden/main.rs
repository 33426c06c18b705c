//! Whole scenarios against the official evaluator: features, log-likelihoods and scores.
//!
//! Values are of wheels 1.6.0 (2023 V0), 1.6.1 (2023 V1), 1.6.4 (2024) and 1.6.7 (2025) of the
//! Waymo Open Dataset. Synthetic data lies in `tests/golden/realism`; a recorded scenario is read
//! from beside the checkout, if it is there. Tolerances are those of the issue that asked for this;
//! `cargo test -p gump-wosac --test realism_golden -- --nocapture` prints what is reached.
#![expect(clippy::unwrap_used, reason = "a test fails by panicking")]

#[path = "../../../../tests/shared.rs"]
mod shared_data;

use std::io::Read as _;
use std::path::{Path, PathBuf};

use gump_proto::{Scenario, ScenarioRollouts, SimAgentsChallengeSubmission};
use gump_wosac::realism::{
    Algorithm, Component, Config, Estimator, FeatureConfig, Features, Log, Mode, Reference,
    Rollouts, Scores, Year,
};
use prost::Message;
use serde_json::Value;

const SHIPPED: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/tests/golden/realism");

/// Likelihoods and scores.
const SCORE_TOLERANCE: f64 = 1e-5;
/// Features, relative to the larger of 1 and themselves: they are f32 at world coordinates.
const FEATURE_TOLERANCE: f64 = 1e-4;

/// A scenario with golden values.
struct Case {
    id: &'static str,
    log: Log,
}

impl Case {
    fn synthetic() -> Self {
        let id = "syn0000000000001";
        Self::read(
            id,
            &Path::new(SHIPPED).join("scenario_syn0000000000001.tfrecord.gz"),
        )
    }

    /// The recorded scenario; `None`, with a message, if recorded data is not available.
    fn recorded() -> Option<Self> {
        let path = shared_data::shared("data/waymo/scenario_a.tfrecord")?;
        Some(Self::read("637f20cafde22ff8", &path))
    }

    fn all() -> Vec<Self> {
        std::iter::once(Self::synthetic())
            .chain(Self::recorded())
            .collect()
    }

    fn read(id: &'static str, path: &Path) -> Self {
        let bytes = bytes(path);
        // A TFRecord: length and its checksum, message, checksum.
        let message = Scenario::decode(&bytes[12..bytes.len() - 4]).unwrap();
        Self {
            id,
            log: Log::of_message(&message),
        }
    }

    fn is_synthetic(&self) -> bool {
        self.id.starts_with("syn")
    }

    fn golden(&self, folder: &str, name: &str) -> Value {
        serde_json::from_slice(&bytes(&self.path(folder, name))).unwrap()
    }

    fn path(&self, folder: &str, name: &str) -> PathBuf {
        if self.is_synthetic() {
            Path::new(SHIPPED).join(format!("{name}.gz"))
        } else {
            beside(&format!("golden/wosac/{folder}/{name}"))
        }
    }

    fn file(&self, name: &str) -> ScenarioRollouts {
        let bytes = bytes(&self.path("inputs", &format!("rollouts_{}_{name}.binproto", self.id)));
        ScenarioRollouts::decode(bytes.as_slice()).unwrap()
    }

    /// The rollouts of a set of the goldens.
    fn rollouts(&self, set: &str) -> Rollouts {
        match set {
            "oracle" => self.log.oracle(32, false),
            "scenariogen_oracle" => self.log.oracle(32, true),
            "cv" => rollouts(&self.file("cv_1scene"), set).repeated(32),
            "noise" if !self.is_synthetic() => {
                let mut both = self.file("noise_part0");
                both.joint_scenes
                    .extend(self.file("noise_part1").joint_scenes);
                rollouts(&both, set)
            }
            "submission" => {
                let name = "golden/wosac/inputs_real/test_submission.binproto.gz";
                let bytes = bytes(&beside(name));
                let submission = SimAgentsChallengeSubmission::decode(bytes.as_slice()).unwrap();
                rollouts(&submission.scenario_rollouts[0], set)
            }
            set => rollouts(&self.file(set), set),
        }
    }
}

/// Converts a message to rollouts; sets of the scenario generation challenge state sizes, too.
fn rollouts(message: &ScenarioRollouts, set: &str) -> Rollouts {
    let mode = match set.starts_with("scenariogen") {
        true => Mode::Generation,
        false => Mode::SimAgents,
    };
    Rollouts::of_message(message, mode)
}

/// Path of a file beside a recorded scenario, which must exist.
fn beside(name: &str) -> PathBuf {
    shared_data::shared(name).expect("golden values lie beside the recorded scenario")
}

/// A file's content, unpacked.
fn bytes(path: &Path) -> Vec<u8> {
    let mut bytes = Vec::new();
    let mut file = std::fs::File::open(path).unwrap_or_else(|e| panic!("{}: {e}", path.display()));
    if path.extension().is_some_and(|extension| extension == "gz") {
        flate2::read::GzDecoder::new(file)
            .read_to_end(&mut bytes)
            .unwrap();
    } else {
        file.read_to_end(&mut bytes).unwrap();
    }
    bytes
}

const VARIANTS: [(&str, Year); 4] = [
    ("2023v0", Year::Y2023V0),
    ("2023v1", Year::Y2023),
    ("2024", Year::Y2024),
    ("2025", Year::Y2025),
];

/// The largest difference found so far, and where.
#[derive(Default)]
struct Worst(f64, String);

impl Worst {
    #[track_caller]
    fn check(&mut self, found: f64, expected: f64, scale: f64, tolerance: f64, what: &str) {
        let off = (found - expected).abs() / scale;
        let both_nan = found.is_nan() && expected.is_nan();
        assert!(
            off <= tolerance || both_nan,
            "{what}: found {found}, expected {expected}"
        );
        if off > self.0 {
            *self = Self(off, what.into());
        }
    }
}

/// As the goldens write booleans.
fn bits(values: &[bool]) -> String {
    values.iter().map(|&b| if b { '1' } else { '0' }).collect()
}

fn number(value: &Value) -> f64 {
    value.as_f64().unwrap_or(f64::NAN)
}

#[test]
fn scores_are_the_official_ones() {
    for case in Case::all() {
        for (variant, year) in VARIANTS {
            let golden = case.golden("", &format!("metrics_{variant}.json"));
            let sets = golden["results"][case.id].as_object().unwrap();
            let (mut worst, mut worst_distance) = (Worst::default(), Worst::default());
            for (set, results) in sets {
                let rollouts = case.rollouts(set);
                let configs = results.as_object().unwrap().iter();
                for (name, result) in configs.filter(|(_, result)| result["metrics"].is_object()) {
                    let mode = if set.starts_with("scenariogen") {
                        Mode::Generation
                    } else {
                        Mode::SimAgents
                    };
                    let text = golden["configs"][name].as_str().unwrap();
                    let config = config_of(text, mode, Config::of(year).algorithm);
                    let reference = Reference::new(&case.log, &config).unwrap();
                    let evaluation = reference.evaluate(&rollouts).unwrap();
                    let what = format!("{} {variant} {set} {name}", case.id);
                    check_scores(&evaluation.scores, result, &mut worst, &what);
                    let expected = &results["average_displacement_error_per_rollout_object"];
                    if let (Some(rows), Mode::SimAgents) = (expected.as_array(), mode) {
                        for (row, found) in rows.iter().zip(&evaluation.displacements) {
                            for (e, f) in row.as_array().unwrap().iter().zip(found) {
                                let (found, expected) = (f64::from(*f), number(e));
                                let scale = expected.max(1.0);
                                let tolerance = SCORE_TOLERANCE;
                                worst_distance.check(found, expected, scale, tolerance, &what);
                            }
                        }
                    }
                }
            }
            println!(
                "{} {variant}: scores within {:.1e} ({})",
                case.id, worst.0, worst.1
            );
        }
    }
}

fn check_scores(scores: &Scores, golden: &Value, worst: &mut Worst, what: &str) {
    let metrics = &golden["metrics"];
    let mut check = |found: f64, expected: &Value, key: &str| {
        if expected.is_number() {
            let what = format!("{what}: {key}");
            worst.check(found, number(expected), 1.0, SCORE_TOLERANCE, &what);
        }
    };
    for (&component, &found) in &scores.components {
        let key = match component {
            Component::Collision => "collision_indication_likelihood".into(),
            Component::Offroad => "offroad_indication_likelihood".into(),
            other => format!("{}_likelihood", other.name()),
        };
        assert!(metrics[&key].is_number(), "{key}");
        check(found, &metrics[&key], &key);
    }
    let rates = [
        ("metametric", scores.metametric),
        ("average_displacement_error", scores.ade),
        ("min_average_displacement_error", scores.min_ade),
        ("simulated_collision_rate", scores.collision_rate),
        ("simulated_offroad_rate", scores.offroad_rate),
        (
            "simulated_traffic_light_violation_rate",
            scores.traffic_light_violation_rate.unwrap_or_default(),
        ),
    ];
    for (key, found) in rates {
        check(found, &metrics[key], key);
    }
    let buckets = &golden["bucketed"];
    check(scores.kinematic, &buckets["kinematic_metrics"], "kinematic");
    check(
        scores.interactive,
        &buckets["interactive_metrics"],
        "interactive",
    );
    check(scores.map_based, &buckets["map_based_metrics"], "map_based");
}

/// Settings from the reference's own text, so that ours are checked against them too.
fn config_of(text: &str, mode: Mode, algorithm: Algorithm) -> Config {
    let section = |name: &str| {
        let start = text.find(&format!("{name} {{"))? + name.len() + 2;
        let mut depth = 1;
        let end = text[start..].find(|c| {
            depth += i32::from(c == '{') - i32::from(c == '}');
            depth == 0
        })?;
        Some(&text[start..start + end])
    };
    let feature = |name: &str| {
        let body = section(name)?;
        let value = |key: &str| -> Option<&str> {
            let after = &body[body.find(&format!("{key}:"))? + key.len() + 1..];
            after.split_whitespace().next()
        };
        let f32_of = |key: &str| value(key).map(|v| v.parse::<f32>().unwrap());
        let pseudocount = f32_of("additive_smoothing_pseudocount").unwrap_or(0.001);
        Some(FeatureConfig {
            estimator: if body.contains("histogram") {
                Estimator::Histogram {
                    min: f32_of("min_val").unwrap(),
                    max: f32_of("max_val").unwrap(),
                    bins: value("num_bins").unwrap().parse().unwrap(),
                    pseudocount,
                }
            } else {
                Estimator::Bernoulli { pseudocount }
            },
            independent_timesteps: value("independent_timesteps") == Some("true"),
            aggregate_agents: value("aggregate_objects") == Some("true"),
            weight: f32_of("metametric_weight").unwrap_or_default(),
        })
    };
    let some = |name| feature(name).unwrap();
    Config {
        algorithm,
        mode,
        linear_speed: some("linear_speed"),
        linear_acceleration: some("linear_acceleration"),
        angular_speed: some("angular_speed"),
        angular_acceleration: some("angular_acceleration"),
        distance_to_nearest_object: some("distance_to_nearest_object"),
        collision: some("collision_indication"),
        time_to_collision: some("time_to_collision"),
        distance_to_road_edge: some("distance_to_road_edge"),
        offroad: some("offroad_indication"),
        traffic_light_violation: feature("traffic_light_violation"),
    }
}

#[test]
fn shipped_settings_are_the_official_ones() {
    let case = Case::synthetic();
    for (variant, key, year) in [
        ("2023v0", "challenge_2023", Year::Y2023V0),
        ("2023v1", "challenge_2023", Year::Y2023),
        ("2024", "challenge_2024", Year::Y2024),
        ("2025", "challenge_2025_sim_agents", Year::Y2025),
        ("2025", "challenge_2025_scenario_gen", Year::Y2025Generation),
    ] {
        let golden = case.golden("", &format!("metrics_{variant}.json"));
        let shipped = Config::of(year);
        let text = golden["configs"][key].as_str().unwrap();
        let mut official = config_of(text, shipped.mode, shipped.algorithm);
        if year == Year::Y2024 {
            // The file got an entry of weight 0 a year later.
            official.traffic_light_violation = None;
        }
        assert_eq!(shipped, official, "{year:?}");
    }
}

#[test]
fn features_are_the_official_ones() {
    for case in Case::all() {
        for (variant, year) in VARIANTS {
            let config = Config::of(year);
            let reference = Reference::new(&case.log, &config).unwrap();
            let name = format!("log_{}_{variant}.json", case.id);
            check_features(
                &[reference.features()],
                &case.golden("features", &name),
                &name,
            );
            if matches!(year, Year::Y2023 | Year::Y2025) {
                let evaluation = reference.evaluate(&case.rollouts("noise")).unwrap();
                let name = format!("sim_{}_noise_first6_{variant}.json", case.id);
                let first: Vec<_> = evaluation.imagined.iter().take(6).collect();
                check_features(&first, &case.golden("features", &name), &name);
            }
        }
    }
    let case = Case::synthetic();
    let config = Config::of(Year::Y2025Generation);
    let reference = Reference::new(&case.log, &config).unwrap();
    let name = "log_syn0000000000001_2025_scenariogen.json";
    check_features(
        &[reference.features()],
        &case.golden("features", name),
        name,
    );
}

fn check_features(found: &[&Features], golden: &Value, name: &str) {
    let ids: Vec<i64> = golden["object_id"]
        .as_array()
        .unwrap()
        .iter()
        .map(|v| v.as_i64().unwrap())
        .collect();
    let mut worst = Worst::default();
    for (rollout, features) in found.iter().enumerate() {
        assert_eq!(features.agents.iter().map(|a| a.0).collect::<Vec<_>>(), ids);
        for component in Component::ALL {
            let key = match component {
                Component::Collision => "collision_per_step",
                Component::Offroad => "offroad_per_step",
                Component::TrafficLightViolation => "traffic_light_violation_per_step",
                other => other.name(),
            };
            if !golden[key].is_array() {
                // Before 2024 the reference tells only whether an indication ever holds.
                assert!(component.is_indication(), "{name}");
                continue;
            }
            for agent in 0..ids.len() {
                let expected = &golden[key][rollout][agent];
                let steps = agent * features.n_steps..(agent + 1) * features.n_steps;
                let what = format!("{name} {key} rollout {rollout} agent {}", ids[agent]);
                if component.is_indication() {
                    assert_eq!(bits(&features.holds(component)[steps]), *expected, "{what}");
                } else {
                    let expected = expected.as_array().unwrap();
                    assert_eq!(expected.len(), features.n_steps);
                    for (found, expected) in features.values(component)[steps].iter().zip(expected)
                    {
                        // Parsed as the f32 that was printed.
                        let expected = f64::from(number(expected) as f32);
                        let scale = expected.abs().max(1.0);
                        worst.check((*found).into(), expected, scale, FEATURE_TOLERANCE, &what);
                    }
                }
            }
        }
    }
    println!("{name}: features within {:.1e} ({})", worst.0, worst.1);
}

#[test]
fn log_likelihoods_are_the_official_ones() {
    for case in Case::all() {
        for (variant, year) in VARIANTS {
            let config = Config::of(year);
            let reference = Reference::new(&case.log, &config).unwrap();
            let evaluation = reference.evaluate(&case.rollouts("noise")).unwrap();
            let name = format!("loglik_{}_noise_{variant}.json", case.id);
            let golden = case.golden("loglik", &name);
            let mut worst = Worst::default();
            for component in Component::ALL {
                let key = match component {
                    Component::Collision => "collision_indication",
                    Component::Offroad => "offroad_indication",
                    other => other.name(),
                };
                let Some(found) = evaluation.log_likelihoods(component) else {
                    assert!(golden[key].is_null(), "{key}");
                    continue;
                };
                let rows = golden[key].as_array().unwrap().iter();
                let expected: Vec<f64> = rows
                    .flat_map(|row| match row.as_array() {
                        Some(steps) => steps.iter().map(number).collect(),
                        None => vec![number(row)],
                    })
                    .collect();
                if component.is_indication() {
                    let (log, imagined) = evaluation.indications(component);
                    assert_eq!(bits(&log), golden[&format!("{key}__log")], "{name}");
                    for (rollout, found) in imagined.iter().enumerate() {
                        assert_eq!(
                            bits(found),
                            golden[&format!("{key}__sim")][rollout],
                            "{name}"
                        );
                    }
                }
                assert_eq!(found.len(), expected.len(), "{key}");
                for (found, expected) in found.iter().zip(expected) {
                    let what = format!("{name} {key}");
                    worst.check((*found).into(), expected, 1.0, SCORE_TOLERANCE, &what);
                }
            }
            println!(
                "{name}: log-likelihoods within {:.1e} ({})",
                worst.0, worst.1
            );
        }
    }
}

#[test]
fn equal_rollouts_need_not_be_repeated() {
    let case = Case::synthetic();
    let config = Config::of(Year::Y2025);
    let reference = Reference::new(&case.log, &config).unwrap();
    let once = case.rollouts("cv");
    let mut often = once.clone();
    often.copies = 1;
    often.futures = vec![once.futures[0].clone(); 32];
    let scores = |rollouts| reference.evaluate(rollouts).unwrap().scores;
    assert_eq!(scores(&once), scores(&often));
}
