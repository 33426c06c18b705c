//! The algorithms by which a policy learns.

use std::fmt;
use std::str::FromStr;

use serde::de::IntoDeserializer as _;
use serde::de::value::Error as NameError;
use serde::{Deserialize, Serialize};

/// The algorithm by which a policy learns.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
#[non_exhaustive]
pub enum Algorithm {
    /// Soft actor-critic: rewards, with a share of expert transitions. Few environment steps.
    Sac,
    /// Proximal policy optimization: imitation first, then rewards. Many environment steps.
    Ppo,
    /// Expert transitions only; no environment is needed.
    Imitation,
}

impl Algorithm {
    /// All of them, in the order of declaration.
    pub const ALL: [Self; 3] = [Self::Sac, Self::Ppo, Self::Imitation];
}

impl fmt::Display for Algorithm {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.serialize(f)
    }
}

impl FromStr for Algorithm {
    type Err = NameError;

    /// Finds a value by the name that it is stored and displayed under.
    ///
    /// # Errors
    /// A sentence with the unknown name and the known ones.
    fn from_str(name: &str) -> Result<Self, NameError> {
        Self::deserialize(name.into_deserializer())
    }
}
