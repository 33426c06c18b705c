//! Shards: the assignment of scenarios to machines.

use std::fmt;
use std::str::FromStr;

use serde::{Deserialize, Serialize};

use crate::{ArgumentError, EvalError, ShardError};

/// Part `k` of `n`. Scenarios are assigned in turn, so shards are similar in size and content.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(try_from = "String", into = "String")]
pub struct Shard {
    /// From 1.
    pub k: usize,
    /// At least `k`.
    pub n: usize,
}

impl Shard {
    /// All scenarios.
    pub const WHOLE: Self = Self { k: 1, n: 1 };

    /// The shard that a scheduler assigns to this process, from the environment variables that
    /// `variable` looks up.
    ///
    /// Supported are Slurm's array (`SLURM_ARRAY_TASK_ID`, `_MIN`, `_STEP`, `_COUNT`) and tasks
    /// (`SLURM_PROCID`, `SLURM_NTASKS`), nested where both are set; otherwise the index of a
    /// Kubernetes job (`JOB_COMPLETION_INDEX`). Kubernetes does not tell a pod the number of
    /// shards: `GUMP_SHARDS` does, and it also overrides the count of Slurm.
    ///
    /// # Errors
    /// [`ShardError`], which has the variable that is missing or wrong.
    pub fn of_variables(variable: impl Fn(&str) -> Option<String>) -> Result<Self, EvalError> {
        let number = |name: &'static str| {
            let text = variable(name).filter(|text| !text.is_empty());
            let parsed = text.map(|text| {
                let number = text.trim().parse::<usize>();
                number.map_err(|_| ShardError::Variable {
                    variable: name,
                    found: text,
                })
            });
            parsed.transpose().map_err(ArgumentError::Shard)
        };
        let array = match number("SLURM_ARRAY_TASK_ID")? {
            Some(id) => {
                let min = number("SLURM_ARRAY_TASK_MIN")?.unwrap_or(0);
                let step = number("SLURM_ARRAY_TASK_STEP")?.unwrap_or(1).max(1);
                Some((
                    id.saturating_sub(min) / step,
                    number("SLURM_ARRAY_TASK_COUNT")?,
                ))
            }
            None => None,
        };
        let task = match number("SLURM_PROCID")? {
            Some(id) => Some((id, number("SLURM_NTASKS")?)),
            None => None,
        };
        let (index, known) = match (array, task, number("JOB_COMPLETION_INDEX")?) {
            (Some((i, n)), Some((k, Some(m))), _) if m > 1 => (i * m + k, n.map(|n| n * m)),
            (Some(found), ..) | (None, Some(found), _) => found,
            (None, None, Some(index)) => (index, None),
            (None, None, None) => return Err(wrong(ShardError::NoScheduler)),
        };
        let n = number("GUMP_SHARDS")?.or(known);
        let n = n.ok_or_else(|| wrong(ShardError::NoCount))?;
        if index >= n {
            return Err(wrong(ShardError::BeyondLast { n, index }));
        }
        Ok(Self { k: index + 1, n })
    }

    /// True if the scenario at `index` of all is this shard's.
    pub fn holds(self, index: usize) -> bool {
        index % self.n == self.k - 1
    }
}

fn wrong(error: ShardError) -> EvalError {
    ArgumentError::Shard(error).into()
}

impl FromStr for Shard {
    type Err = EvalError;

    /// Reads `K/N`.
    ///
    /// # Errors
    /// [`ShardError::Malformed`].
    fn from_str(text: &str) -> Result<Self, EvalError> {
        let parts = text.split_once('/');
        match parts.map(|(k, n)| (k.parse(), n.parse())) {
            Some((Ok(k), Ok(n))) if 1 <= k && k <= n => Ok(Self { k, n }),
            _ => {
                let found = text.into();
                Err(wrong(ShardError::Malformed { found }))
            }
        }
    }
}

impl TryFrom<String> for Shard {
    type Error = EvalError;

    fn try_from(text: String) -> Result<Self, EvalError> {
        text.parse()
    }
}

impl fmt::Display for Shard {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}/{}", self.k, self.n)
    }
}

impl From<Shard> for String {
    fn from(shard: Shard) -> Self {
        shard.to_string()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn shards_share_out_everything_once() {
        for index in 0..20 {
            let owners = (1..=3).filter(|&k| Shard { k, n: 3 }.holds(index));
            assert_eq!(owners.count(), 1);
        }
        assert!((0..9).all(|index| Shard::WHOLE.holds(index)));
    }

    #[test]
    fn schedulers_say_which_part_is_whose() {
        let auto = |set: &[(&str, &str)]| {
            let found = Shard::of_variables(|name| {
                let value = set.iter().find(|(known, _)| *known == name);
                value.map(|(_, value)| (*value).to_owned())
            });
            let written = found.map(|shard| shard.to_string());
            written.map_err(|error| error.to_string())
        };
        let array = [
            ("SLURM_ARRAY_TASK_ID", "7"),
            ("SLURM_ARRAY_TASK_MIN", "1"),
            ("SLURM_ARRAY_TASK_STEP", "2"),
            ("SLURM_ARRAY_TASK_COUNT", "8"),
        ];
        assert_eq!(auto(&array).unwrap(), "4/8");
        let tasks = [("SLURM_PROCID", "2"), ("SLURM_NTASKS", "3")];
        assert_eq!(auto(&tasks).unwrap(), "3/3");
        // Tasks within an array; a job of one task is not split further.
        assert_eq!(auto(&[&array[..], &tasks[..]].concat()).unwrap(), "12/24");
        let one = [("SLURM_PROCID", "0"), ("SLURM_NTASKS", "1")];
        assert_eq!(auto(&[&array[..], &one[..]].concat()).unwrap(), "4/8");
        let pod = ("JOB_COMPLETION_INDEX", "0");
        assert_eq!(auto(&[pod, ("GUMP_SHARDS", "5")]).unwrap(), "1/5");
        assert!(auto(&[pod]).unwrap_err().contains("GUMP_SHARDS"));
        assert!(auto(&[]).unwrap_err().contains("SLURM_PROCID"));
        let error = auto(&[pod, ("GUMP_SHARDS", "many")]).unwrap_err();
        assert!(error.contains("found \"many\""), "{error}");
        let error = auto(&[("JOB_COMPLETION_INDEX", "5"), ("GUMP_SHARDS", "5")]).unwrap_err();
        assert!(error.contains("found number 5"), "{error}");
    }

    #[test]
    fn shards_read_as_they_are_written() {
        assert_eq!("2/8".parse::<Shard>().unwrap().to_string(), "2/8");
        for wrong in ["", "3", "0/4", "5/4", "1/0", "a/b", "-1/2"] {
            assert!(wrong.parse::<Shard>().is_err(), "{wrong}");
        }
    }
}
