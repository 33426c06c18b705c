//! Motion prediction metrics of the Waymo challenge: distances of the best mode, misses, overlaps
//! and mean average precision, by kind of agent at 3, 5 and 8 s.
//!
//! Start with [`evaluate_predictions`], which measures the predictions of one scenario. Add the
//! scores of many to a [`MotionTally`] and read its [`rows`](MotionTally::rows). [`forecast`] turns
//! a world's futures into predictions. Files are read and written by `gump-data`.
//!
//! ```
//! use gump_geometry::dvec2;
//! use gump_wosac::motion::{MotionConfig, MotionTally, evaluate_predictions};
//! use gump_scene::{PredictedMode, Prediction};
//!
//! let mut scenario = gump_scene::fixture::scenario(
//!     "ego vehicle 0: 0,0 velocity 5,0\nhistory 1 future 8 dt 0.1",
//! ).unwrap();
//! scenario.targets = vec![scenario.ego];
//! // Straight on, but 1 m to the left: one position every half second.
//! let path = (1..=16).map(|k| dvec2(2.5 * f64::from(k), 1.0)).collect();
//! let mode = PredictedMode { confidence: 1.0, paths: vec![path] };
//! let prediction = Prediction { agents: vec![scenario.ego], modes: vec![mode] };
//! let config = MotionConfig::challenge();
//! let scores = evaluate_predictions(&scenario, &[prediction], &config)?;
//! let rows = MotionTally::of(&scores).rows(&config);
//! assert!((rows[0].min_ade.unwrap() - 1.0).abs() < 1e-9);
//! // At 3 s a vehicle at 5 m/s may be 0.69 m beside its path, at 8 s 2.06 m.
//! assert_eq!((rows[0].miss_rate, rows[2].miss_rate), (Some(1.0), Some(0.0)));
//! # Ok::<(), gump_wosac::motion::MotionError>(())
//! ```

mod config;
mod error;
mod evaluate;
mod forecast;
mod mean;
mod measure;
mod precision;
mod shape;
mod tally;

pub use config::{Horizon, MotionConfig, ShapeRules, SpeedScale};
pub use error::{MotionError, MotionProblem};
pub use evaluate::{HorizonScore, ModeScore, PredictionScore, evaluate_predictions};
pub use forecast::forecast;
pub use mean::Mean;
pub use precision::{PrecisionSamples, Sample};
pub use shape::{Shape, shape};
pub use tally::{MotionCell, MotionRow, MotionTally};
