//! Observations of an episode: numbers (`vector`) or an image (`raster`).

mod buffer;
mod raster;
mod vector;

use gump_scene::Frame;
use serde::{Deserialize, Serialize};

use crate::networks::Picture;
use crate::{EpisodeState, PreparedScenario, RlError};

pub(crate) use buffer::{Observed, ObservedRow};
pub use raster::{RASTER_LAYERS, RasterView, expand};
pub(crate) use raster::{Texture, pack};
pub use vector::{AgentOrder, VectorView};

/// The form of an observation.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case", deny_unknown_fields)]
#[non_exhaustive]
pub enum ObservationSpec {
    /// A short vector of numbers in the ego's frame.
    Vector(VectorView),
    /// A bird's-eye image centred on the ego, with layers that are 0 or 1.
    Raster(RasterView),
}

impl Default for ObservationSpec {
    fn default() -> Self {
        Self::Vector(VectorView::default())
    }
}

impl ObservationSpec {
    /// The axes of an observation: `[numbers]` or `[layer, row, column]`.
    pub fn shape(&self) -> Vec<usize> {
        match self {
            Self::Vector(view) => vec![view.len()],
            Self::Raster(view) => vec![RASTER_LAYERS.len(), view.side_px, view.side_px],
        }
    }

    /// The form in which replay buffers store it and networks read it.
    pub fn form(&self) -> ObservationForm {
        match self {
            Self::Vector(view) => ObservationForm::Numbers(view.len()),
            Self::Raster(view) => ObservationForm::Bits(Picture {
                layers: RASTER_LAYERS.len(),
                side: view.side_px,
            }),
        }
    }

    /// Length of an observation.
    #[allow(
        clippy::len_without_is_empty,
        reason = "an observation always holds the ego"
    )]
    pub fn len(&self) -> usize {
        self.shape().iter().product()
    }

    /// Bytes of a packed observation; 0 for vectors, which are not packed.
    pub fn packed_len(&self) -> usize {
        match self {
            Self::Vector(_) => 0,
            Self::Raster(view) => view.packed_len(),
        }
    }

    /// Refuses parameters out of range.
    pub(crate) fn check(&self) -> Result<(), RlError> {
        let parameters = match self {
            Self::Vector(view) => [
                ("route_spacing", view.route_spacing),
                ("agent_range", view.agent_range),
                ("ray_range", view.ray_range),
            ],
            Self::Raster(view) => {
                let whole_bytes = view.side_px > 0 && view.side_px.is_multiple_of(8);
                if !whole_bytes {
                    return Err(RlError::Parameter {
                        name: "side_px",
                        value: view.side_px as f64,
                        expected: "a positive multiple of 8",
                    });
                }
                [("metres_per_px", view.metres_per_px); 3]
            }
        };
        match parameters
            .into_iter()
            .find(|(_, v)| !(*v > 0.0 && v.is_finite()))
        {
            Some((name, value)) => Err(RlError::Parameter {
                name,
                value,
                expected: "a positive number",
            }),
            None => Ok(()),
        }
    }
}

/// The form of observations, as far as learners need it.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
#[non_exhaustive]
pub enum ObservationForm {
    /// This many numbers of any size.
    Numbers(usize),
    /// An image of numbers that are 0 or 1.
    Bits(Picture),
}

impl ObservationForm {
    /// Numbers in an observation.
    #[allow(clippy::len_without_is_empty, reason = "as of `ObservationSpec`")]
    pub fn len(&self) -> usize {
        match self {
            Self::Numbers(len) => *len,
            Self::Bits(picture) => picture.len(),
        }
    }
}

impl From<usize> for ObservationForm {
    fn from(len: usize) -> Self {
        Self::Numbers(len)
    }
}

impl From<Picture> for ObservationForm {
    fn from(picture: Picture) -> Self {
        Self::Bits(picture)
    }
}

/// An episode at one instant, as input of an observation.
#[derive(Clone, Copy, Debug)]
pub struct View<'a> {
    /// Its scenario.
    pub prepared: &'a PreparedScenario,
    /// Its state.
    pub state: &'a EpisodeState,
    /// All agents now. The ego in it is ignored.
    pub now: &'a Frame,
    /// All agents one step ago, if known.
    pub before: Option<&'a Frame>,
}

/// Writes the observation of an episode in the form of `spec`.
///
/// Shape: `numbers` is `[spec.len()]`, or empty where the bits of a raster suffice; `packed` is
/// `[spec.packed_len()]`; both are overwritten.
pub fn observe(spec: &ObservationSpec, view: &View<'_>, numbers: &mut [f32], packed: &mut [u8]) {
    match spec {
        ObservationSpec::Vector(vector) => vector.observe(view, numbers),
        ObservationSpec::Raster(raster) => {
            raster.observe(view, packed);
            expand(packed, numbers);
        }
    }
}
