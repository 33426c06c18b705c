//! The specification of a raster.

use crate::Layer;

/// Size, resolution and layers of a raster.
#[derive(Clone, Debug, PartialEq)]
pub struct RasterSpec {
    /// Pixels along each side of the square, > 0.
    pub side_px: usize,
    /// Metres along each side of a pixel, > 0.
    pub metres_per_px: f64,
    /// The planes, in the order in which they are stored.
    pub layers: Vec<Layer>,
}

impl RasterSpec {
    /// A raster of these layers.
    pub fn new(side_px: usize, metres_per_px: f64, layers: Vec<Layer>) -> Self {
        Self {
            side_px,
            metres_per_px,
            layers,
        }
    }

    /// The nine planes that the released model reads, 416 px at 0.5 m (±104 m).
    ///
    /// Two of them differ in scale from the release, which leaves them unbounded: the light index
    /// is divided by 64 and the coordinates by the half extent.
    ///
    /// Source: the GUMP paper's code; the paper itself gives no numbers.
    pub fn paper() -> Self {
        let layers = vec![
            Layer::Roadmap,
            Layer::BaselinePaths,
            Layer::Route,
            Layer::DrivableArea,
            Layer::SpeedLimit,
            Layer::StaticAgents,
            Layer::TrafficLightIndex,
            Layer::CoordinateX,
            Layer::CoordinateY,
        ];
        Self::new(416, 0.5, layers)
    }

    /// Sixteen planes that contain all map data; the colours of lights are left to tokens.
    pub fn full(side_px: usize, metres_per_px: f64) -> Self {
        let layers = vec![
            Layer::RoadLines,
            Layer::RoadEdge,
            Layer::Crosswalk,
            Layer::StopLine,
            Layer::SpeedBump,
            Layer::BaselinePaths,
            Layer::LaneDirectionCos,
            Layer::LaneDirectionSin,
            Layer::Route,
            Layer::DrivableArea,
            Layer::SpeedLimit,
            Layer::StaticAgents,
            Layer::TrafficLightOccupancy,
            Layer::TrafficLightIndex,
            Layer::CoordinateX,
            Layer::CoordinateY,
        ];
        Self::new(side_px, metres_per_px, layers)
    }

    /// The same raster with three more planes for the present colours of lights, for models
    /// without light tokens.
    pub fn with_light_colours(mut self) -> Self {
        self.layers.extend([
            Layer::TrafficLightRed,
            Layer::TrafficLightYellow,
            Layer::TrafficLightGreen,
        ]);
        self
    }

    /// Metres along each side of the square.
    pub fn extent_m(&self) -> f64 {
        self.side_px as f64 * self.metres_per_px
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_paper_covers_104_metres_each_way() {
        let spec = RasterSpec::paper();
        assert_eq!((spec.extent_m(), spec.layers.len()), (208.0, 9));
        assert_eq!(RasterSpec::full(208, 1.0).layers.len(), 16);
        assert_eq!(
            RasterSpec::full(208, 1.0).with_light_colours().layers[18],
            Layer::TrafficLightGreen
        );
    }
}
