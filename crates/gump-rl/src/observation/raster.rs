//! Bird's-eye images of an episode, one bit per pixel and layer.
//!
//! The map is rendered once per scenario, north up (`Texture`); an observation samples it and draws
//! the moving agents on top.

use gump_geometry::{Canvas, DVec2, Pose, dvec2, fill_polygon, stroke_polyline};
use gump_raster::{Layer, RasterSpec, rasterize};
use gump_scene::{AgentId, Frame, Light, LightState};
use serde::{Deserialize, Serialize};

use super::View;
use crate::PreparedScenario;

/// Size and scale of a raster observation; the ego is at its centre and faces up.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct RasterView {
    /// Pixels along each side of the square, a positive multiple of 8.
    pub side_px: usize,
    /// Metres along each side of a pixel, > 0.
    pub metres_per_px: f64,
}

/// The layers of a raster observation in order. Row 0 is ahead, column 0 left.
///
/// The speed layer fills a share of its pixels with 1, from the first row on; all of them at 24
/// m/s.
pub const RASTER_LAYERS: [&str; 8] = [
    "drivable_area",
    "baseline_paths",
    "route",
    "road_edge",
    "red_light_lanes",
    "agents",
    "agents_one_step_ago",
    "ego_speed",
];

/// The first layers, which show the map.
const MAP_LAYERS: [Layer; 4] = [
    Layer::DrivableArea,
    Layer::BaselinePaths,
    Layer::Route,
    Layer::RoadEdge,
];
/// Speed at which the speed layer is full, metres per second. Source: the raster of GUMP's released
/// code.
const FULL_SPEED: f64 = 24.0;

impl Default for RasterView {
    /// 64 pixels of 1.5 m, 48 m each way; 4 kB. The paper's policy has 224 pixels of 0.5 m.
    fn default() -> Self {
        Self {
            side_px: 64,
            metres_per_px: 1.5,
        }
    }
}

impl RasterView {
    /// Bytes of a packed observation: `[layer, row, column]`, eight columns to a byte, the first
    /// in its lowest bit.
    pub fn packed_len(&self) -> usize {
        RASTER_LAYERS.len() * self.plane_len()
    }

    fn plane_len(&self) -> usize {
        self.side_px * self.side_px / 8
    }

    /// Shape: `packed` is `[packed_len]`.
    pub(super) fn observe(&self, view: &View<'_>, packed: &mut [u8]) {
        let prepared = view.prepared;
        let texture = prepared.texture.get_or_init(|| Texture::paint(prepared));
        let (map, moving) = packed.split_at_mut(MAP_LAYERS.len() * self.plane_len());
        let pose = view.state.ego.state.pose;
        self.look_up(texture, pose, map);

        let ego = view.state.ego.id;
        let mut planes = moving.chunks_exact_mut(self.plane_len());
        let mut pixels = vec![0.0; self.side_px * self.side_px];
        let mut draw = |has_any: bool, paint: &dyn Fn(&mut Plane<'_>)| {
            let bits = planes.next().expect("there are four layers of what moves");
            bits.fill(0);
            if has_any {
                pixels.fill(0.0);
                paint(&mut Plane::new(self, pose, &mut pixels));
                pack(&pixels, bits);
            }
        };
        let is_red = |light: &Light| light.state == LightState::Red;
        let has_red = view.now.lights().iter().any(is_red);
        draw(has_red, &|plane| plane.red_lights(prepared, view.now));
        draw(true, &|plane| plane.agents(view.now, ego));
        draw(view.before.is_some(), &|plane| {
            if let Some(before) = view.before {
                plane.agents(before, ego);
            }
        });
        let bar = planes.next().expect("the last layer is the speed");
        fill_bits(bar, view.state.ego.state.speed() / FULL_SPEED);
    }

    /// Fills the map's planes for an ego at `pose`.
    fn look_up(&self, texture: &Texture, pose: Pose, planes: &mut [u8]) {
        let (down, right) = (-pose.direction(), -pose.direction().perp());
        let (down, right) = (down * self.metres_per_px, right * self.metres_per_px);
        let first = pose.position - (down + right) * ((self.side_px - 1) as f64 / 2.0);
        let first = (first - texture.corner) / TEXEL;
        let (down, right) = (down / TEXEL, right / TEXEL);
        let (row_len, plane_len) = (self.side_px / 8, self.plane_len());
        let step = [right.x, right.y].map(fixed);
        for row in 0..self.side_px {
            let start = first + down * row as f64;
            let end = start + right * (self.side_px - 1) as f64;
            let is_inside = texture.holds(start) && texture.holds(end);
            let mut at = [start.x, start.y].map(fixed);
            for group in 0..row_len {
                let mut masks = 0u64;
                for i in 0..8 {
                    let [column, row] = at.map(|x| x >> FRACTION);
                    // A straight line between two places inside stays inside.
                    let mask = match is_inside {
                        true => texture.masks[row as usize * TEXTURE_SIDE + column as usize],
                        false => texture.at(column, row),
                    };
                    masks |= u64::from(mask) << (8 * i);
                    at = [at[0] + step[0], at[1] + step[1]];
                }
                for layer in 0..MAP_LAYERS.len() {
                    // Gathers the lowest bits of eight bytes in one: bit 8 i goes to bit 56 + i.
                    let bits = (masks >> layer) & 0x0101_0101_0101_0101;
                    let byte = bits.wrapping_mul(0x0102_0408_1020_4080) >> 56;
                    planes[layer * plane_len + row * row_len + group] = byte as u8;
                }
            }
        }
    }
}

/// Bits behind the point of a place in texels: half of an `i64`, so that neither places nor the
/// errors of a row of steps ever matter.
const FRACTION: u32 = 32;

/// A place in texels with a fixed point: one addition leads to the next pixel.
fn fixed(place: f64) -> i64 {
    (place * (1u64 << FRACTION) as f64).round() as i64
}

/// Sets a share of the bits, from the first on.
fn fill_bits(bytes: &mut [u8], share: f64) {
    let n = (share.clamp(0.0, 1.0) * (8 * bytes.len()) as f64).round() as usize;
    bytes.fill(0);
    bytes[..n / 8].fill(0xFF);
    if let Some(byte) = bytes.get_mut(n / 8) {
        *byte = (1 << (n % 8)) - 1;
    }
}

/// Writes a packed observation as numbers, 0 or 1.
///
/// Shape: `numbers` is eight times as long as `packed`, less what the last byte has left over.
pub fn expand(packed: &[u8], numbers: &mut [f32]) {
    for (byte, numbers) in packed.iter().zip(numbers.chunks_mut(8)) {
        for (i, number) in numbers.iter_mut().enumerate() {
            *number = f32::from((byte >> i) & 1);
        }
    }
}

/// Packs pixels that are 0 or positive. Shape: as [`expand`].
pub(crate) fn pack(pixels: &[f32], packed: &mut [u8]) {
    for (byte, pixels) in packed.iter_mut().zip(pixels.chunks(8)) {
        let bits = pixels.iter().enumerate();
        *byte = bits.fold(0, |byte, (i, v)| byte | (u8::from(*v > 0.0) << i));
    }
}

/// Side of a texel, metres: half of a pixel of the default view.
const TEXEL: f64 = 0.75;
/// Texels along the side of a texture: 288 m to each side of the start, farther than an episode
/// can go and see in eight seconds at 30 m/s.
const TEXTURE_SIDE: usize = 768;

/// The map of a prepared scenario as a bird's-eye image, north up: per texel one bit per layer of the map.
#[derive(Debug)]
pub(crate) struct Texture {
    /// World position of the texel (0, 0)'s lower left corner.
    corner: DVec2,
    /// `[row, column]`, rows along y, columns along x.
    masks: Vec<u8>,
}

impl Texture {
    fn paint(prepared: &PreparedScenario) -> Self {
        let scene = prepared.scenario().present();
        let center = scene.ego_now().state.pose.position;
        // A raster looks up, to +x of its frame: turned by a quarter, its columns lie along x.
        let pose = Pose {
            position: center,
            heading: std::f64::consts::FRAC_PI_2,
        };
        let spec = RasterSpec::new(TEXTURE_SIDE, TEXEL, MAP_LAYERS.to_vec());
        let raster = rasterize(&spec, &scene, pose);
        let mut masks = vec![0u8; TEXTURE_SIDE * TEXTURE_SIDE];
        for (i, layer) in MAP_LAYERS.into_iter().enumerate() {
            // Lines are two texels wide, so that no pixel of an observation steps over them.
            let is_line = matches!(layer, Layer::BaselinePaths | Layer::RoadEdge);
            let plane = raster.layer(i).chunks_exact(TEXTURE_SIDE);
            for (row, pixels) in plane.rev().enumerate() {
                for (column, _) in pixels.iter().enumerate().filter(|(_, v)| **v > 0.0) {
                    let reach = usize::from(is_line);
                    for row in row..=(row + reach).min(TEXTURE_SIDE - 1) {
                        for column in column..=(column + reach).min(TEXTURE_SIDE - 1) {
                            masks[row * TEXTURE_SIDE + column] |= 1 << i;
                        }
                    }
                }
            }
        }
        Self {
            corner: center - TEXTURE_SIDE as f64 * TEXEL / 2.0,
            masks,
        }
    }

    /// The layers of a texel; none outside.
    fn at(&self, column: i64, row: i64) -> u8 {
        // Negative places wrap round to huge ones.
        let (column, row) = (column as usize, row as usize);
        if column < TEXTURE_SIDE && row < TEXTURE_SIDE {
            self.masks[row * TEXTURE_SIDE + column]
        } else {
            0
        }
    }

    /// True for a place that rounding does not move outside.
    fn holds(&self, place: DVec2) -> bool {
        let inside = 1.0..TEXTURE_SIDE as f64 - 1.0;
        inside.contains(&place.x) && inside.contains(&place.y)
    }
}

/// A layer to draw on, in the ego's frame.
struct Plane<'a> {
    canvas: Canvas<'a>,
    side_px: usize,
    metres_per_px: f64,
    center: DVec2,
    forward: DVec2,
}

impl<'a> Plane<'a> {
    fn new(view: &RasterView, pose: Pose, pixels: &'a mut [f32]) -> Self {
        Self {
            canvas: Canvas::new(pixels, view.side_px, view.side_px),
            side_px: view.side_px,
            metres_per_px: view.metres_per_px,
            center: pose.position,
            forward: pose.direction(),
        }
    }

    /// Continuous pixel coordinates, x along columns, y along rows.
    fn pixel(&self, point: DVec2) -> DVec2 {
        let offset = point - self.center;
        let (ahead, left) = (self.forward.dot(offset), self.forward.perp_dot(offset));
        dvec2(-left, -ahead) / self.metres_per_px + self.side_px as f64 / 2.0
    }

    fn agents(&mut self, frame: &Frame, ego: AgentId) {
        let reach = self.side_px as f64 * self.metres_per_px;
        for agent in frame.agents().iter().filter(|agent| agent.id != ego) {
            let place = agent.state.pose.position;
            if place.distance_squared(self.center) > reach * reach {
                continue;
            }
            let ring = agent.oriented_box().corners().map(|c| self.pixel(c));
            fill_polygon(&mut self.canvas, &ring, 1.0);
            // A pedestrian may lie between the centres of pixels.
            let center = self.pixel(place).floor();
            self.canvas.set(center.x as i64, center.y as i64, 1.0);
        }
    }

    fn red_lights(&mut self, prepared: &PreparedScenario, frame: &Frame) {
        for light in frame.lights() {
            if light.state != LightState::Red {
                continue;
            }
            if let Some(lane) = prepared.scenario().map.lane(light.lane) {
                let points = lane.centerline.points().iter().map(|p| self.pixel(*p));
                let points: Vec<DVec2> = points.collect();
                stroke_polyline(&mut self.canvas, &points, 1.0);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Rules;
    use gump_scene::fixture;

    const VIEW: RasterView = RasterView {
        side_px: 16,
        metres_per_px: 2.0,
    };

    /// The layers as text, '#' for 1, one per row of the picture.
    fn draw(text: &str, layer: &str) -> Vec<String> {
        let prepared = PreparedScenario::new(fixture::scenario(text).unwrap(), 0.5).unwrap();
        let state = Rules::default().reset(&prepared);
        let view = View {
            prepared: &prepared,
            state: &state,
            now: prepared.logged(0),
            before: Some(&prepared.scenario().log[prepared.scenario().now - 5]),
        };
        let mut packed = vec![0xAA; VIEW.packed_len()];
        VIEW.observe(&view, &mut packed);
        let mut numbers = vec![f32::NAN; packed.len() * 8];
        expand(&packed, &mut numbers);
        let area = VIEW.side_px * VIEW.side_px;
        let i = RASTER_LAYERS
            .iter()
            .position(|name| *name == layer)
            .unwrap();
        let rows = numbers[i * area..(i + 1) * area].chunks(VIEW.side_px);
        let row = |row: &[f32]| {
            row.iter()
                .map(|v| if *v > 0.0 { '#' } else { '.' })
                .collect()
        };
        rows.map(row).collect()
    }

    // The ego drives north; a car ahead on its left crosses to the right.
    const SCENE: &str = "drivable: 496,0 504,0 504,200 496,200\n
        lane 1: 501,0 501,200\nroute 1\nlight 1 red:\nedge: 505,0 505,200\n
        ego vehicle 0: 500,100 velocity 0,12\nagent vehicle 1: 492,109 velocity 4,0 size 4,2";

    #[test]
    fn a_scene_by_hand() {
        let agents = draw(SCENE, "agents");
        assert_eq!(agents[3], "...##...........");
        assert_eq!(agents.iter().filter(|row| row.contains('#')).count(), 1);
        let before = draw(SCENE, "agents_one_step_ago");
        assert_eq!(before[3], "..##............");
        // 8 m of road, 4 m to each side of the ego.
        let road = draw(SCENE, "drivable_area");
        assert!(road.iter().all(|row| row == "......####......"), "{road:?}");
        for layer in ["baseline_paths", "red_light_lanes"] {
            let lane = draw(SCENE, layer);
            assert!(
                lane.iter().all(|row| row == "........#......."),
                "{layer}: {lane:?}"
            );
        }
        let edge = draw(SCENE, "road_edge");
        assert!(edge.iter().all(|row| row == "..........#....."), "{edge:?}");
        let route = draw(SCENE, "route");
        assert!(route.iter().all(|row| row.contains('#')), "{route:?}");
        // Half of 24 m/s.
        let speed = draw(SCENE, "ego_speed").concat();
        assert_eq!(speed.matches('#').count(), 128);
        assert!(speed.starts_with('#'));
    }

    #[test]
    fn turning_the_world_turns_nothing_else() {
        let north = SCENE;
        // The same scene, everything turned to drive east.
        let east = "drivable: 0,-496 0,-504 200,-504 200,-496\n
            lane 1: 0,-501 200,-501\nroute 1\nlight 1 red:\nedge: 0,-505 200,-505\n
            ego vehicle 0: 100,-500 velocity 12,0\n
            agent vehicle 1: 109,-492 velocity 0,-4 size 4,2";
        for layer in [
            "drivable_area",
            "agents",
            "agents_one_step_ago",
            "red_light_lanes",
        ] {
            assert_eq!(draw(north, layer), draw(east, layer), "{layer}");
        }
    }

    #[test]
    fn packing_loses_nothing() {
        let numbers: Vec<f32> = (0..64u32).map(|i| ((i * 37 % 11) & 1) as f32).collect();
        let mut packed = vec![0; 8];
        pack(&numbers, &mut packed);
        let mut back = vec![f32::NAN; 64];
        expand(&packed, &mut back);
        assert_eq!(back, numbers);
    }
}
