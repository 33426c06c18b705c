//! Scores of the predictions of one scenario, as they are stored.

use gump_scene::{AgentId, AgentKind};
use gump_wosac::motion::{HorizonScore, ModeScore, PredictionScore, Shape};
use serde::{Deserialize, Serialize};

use crate::{EvalError, ResultsError};

/// Scores of one scenario.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ScenarioPredictions {
    /// Targets that could not be predicted because they were absent.
    pub absent: usize,
    /// Of the futures that predictions were condensed from.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub digest: Option<String>,
    /// Every prediction.
    #[serde(default)]
    predictions: Vec<Line>,
}

#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
struct Line {
    agents: Vec<i64>,
    class: String,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    shape: Option<String>,
    horizons: Vec<AtHorizon>,
}

#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
struct AtHorizon {
    #[serde(default, skip_serializing_if = "Option::is_none")]
    min_ade: Option<f64>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    min_fde: Option<f64>,
    overlaps: bool,
    confidences: Vec<f64>,
    /// A letter per mode: y if it matches the log, n if not, ? if unknown.
    matches: String,
}

impl ScenarioPredictions {
    pub(super) fn new(scores: &[PredictionScore], absent: usize, digest: Option<String>) -> Self {
        let line = |score: &PredictionScore| Line {
            agents: score.agents.iter().map(|agent| agent.0).collect(),
            class: score.kind.name().into(),
            shape: score.shape.map(|shape| shape.name().into()),
            horizons: score.horizons.iter().map(at_horizon).collect(),
        };
        Self {
            absent,
            digest,
            predictions: scores.iter().map(line).collect(),
        }
    }

    /// The scores they were made of.
    ///
    /// # Errors
    /// Words that are no class, shape or match.
    pub fn scores(&self) -> Result<Vec<PredictionScore>, EvalError> {
        self.predictions.iter().map(Line::score).collect()
    }
}

fn at_horizon(score: &HorizonScore) -> AtHorizon {
    let letter = |mode: &ModeScore| match mode.matches {
        Some(true) => 'y',
        Some(false) => 'n',
        None => '?',
    };
    AtHorizon {
        min_ade: score.min_ade,
        min_fde: score.min_fde,
        overlaps: score.overlaps,
        confidences: score.modes.iter().map(|mode| mode.confidence).collect(),
        matches: score.modes.iter().map(letter).collect(),
    }
}

impl Line {
    fn score(&self) -> Result<PredictionScore, EvalError> {
        let unknown = |expected, word: &str| ResultsError::UnknownWord {
            expected,
            found: word.into(),
        };
        let mut kinds = AgentKind::MOVING.into_iter().chain(AgentKind::STATIC);
        let kind = kinds.find(|kind| kind.name() == self.class);
        let shape = self.shape.as_deref().map(|name| {
            let mut shapes = Shape::ALL.into_iter();
            let found = shapes.find(|shape| shape.name() == name);
            found.ok_or_else(|| unknown("shape", name))
        });
        Ok(PredictionScore {
            agents: self.agents.iter().copied().map(AgentId).collect(),
            kind: kind.ok_or_else(|| unknown("class", &self.class))?,
            shape: shape.transpose()?,
            horizons: self
                .horizons
                .iter()
                .map(AtHorizon::score)
                .collect::<Result<_, EvalError>>()?,
        })
    }
}

impl AtHorizon {
    fn score(&self) -> Result<HorizonScore, EvalError> {
        let (expected, found) = (self.confidences.len(), self.matches.len());
        if expected != found {
            return Err(ResultsError::MatchCount { expected, found }.into());
        }
        let mode = |(&confidence, letter)| {
            let matches = match letter {
                'y' => Some(true),
                'n' => Some(false),
                '?' => None,
                other => {
                    return Err(ResultsError::UnknownWord {
                        expected: "match",
                        found: other.into(),
                    });
                }
            };
            Ok(ModeScore {
                confidence,
                matches,
            })
        };
        let modes = self.confidences.iter().zip(self.matches.chars()).map(mode);
        Ok(HorizonScore {
            min_ade: self.min_ade,
            min_fde: self.min_fde,
            overlaps: self.overlaps,
            modes: modes.collect::<Result<_, _>>()?,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn scores_survive_the_store_to_the_bit() {
        let mode = |confidence: f64, matches| ModeScore {
            confidence,
            matches,
        };
        let scores = [PredictionScore {
            agents: vec![AgentId(7), AgentId(-3)],
            kind: AgentKind::Bicycle,
            shape: Some(Shape::LeftUTurn),
            horizons: vec![
                HorizonScore {
                    min_ade: Some(0.1 + 0.2),
                    min_fde: None,
                    overlaps: true,
                    modes: vec![mode(1.0 / 3.0, Some(true)), mode(0.0, None)],
                },
                HorizonScore {
                    min_ade: None,
                    min_fde: None,
                    overlaps: false,
                    modes: vec![mode(-1e-30, Some(false))],
                },
            ],
        }];
        let kept = ScenarioPredictions::new(&scores, 2, Some("c0de".into()));
        let text = toml::to_string(&kept).unwrap();
        let read: ScenarioPredictions = toml::from_str(&text).unwrap();
        assert_eq!(read, kept);
        assert_eq!(read.scores().unwrap(), scores);
        for (from, to) in [("y?", "yz"), ("bicycle", "tram"), ("left-u-turn", "loop")] {
            let broken: ScenarioPredictions = toml::from_str(&text.replace(from, to)).unwrap();
            assert!(broken.scores().is_err(), "{to}");
        }
        let nothing = ScenarioPredictions::new(&[], 0, None);
        let text = toml::to_string(&nothing).unwrap();
        assert_eq!(
            toml::from_str::<ScenarioPredictions>(&text).unwrap(),
            nothing
        );
    }
}
