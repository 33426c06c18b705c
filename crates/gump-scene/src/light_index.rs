//! The numbering of traffic lights that tokens and raster share.

use gump_geometry::DVec2;

use crate::{Frame, Light, MapGraph, SceneState};

/// The maximum number of lights with an index; indices run from 1 to this.
///
/// Source: the capacity of 64 in the GUMP paper's code, 0 being "no light".
pub const MAX_LIGHTS: usize = 63;

/// The lights of the present frame with their index 1, 2, 3, ..., nearest first.
///
/// A light counts if its lane is in the map and the lane starts within `radius` of `centre`. Lights
/// are ordered by the distance of that start, then by lane id. A larger radius only appends lights,
/// so a smaller one uses a prefix of the same numbering. At most [`MAX_LIGHTS`].
///
/// Units: world frame, metres. Source: ours; tokens and raster share one numbering, where the
/// paper's code enumerates lights separately for each, over different radii and by state.
pub fn light_indices<'a>(
    scene: &SceneState<'a>,
    centre: DVec2,
    radius: f64,
) -> Vec<(usize, &'a Light)> {
    light_indices_of(scene.map, scene.now(), centre, radius)
}

/// [`light_indices`] of any frame on its map.
pub fn light_indices_of<'a>(
    map: &MapGraph,
    frame: &'a Frame,
    centre: DVec2,
    radius: f64,
) -> Vec<(usize, &'a Light)> {
    let mut lights: Vec<(f64, &Light)> = frame
        .lights()
        .iter()
        .filter_map(|light| {
            let start = map.lane(light.lane)?.centerline.points()[0];
            let distance = start.distance(centre);
            (distance <= radius).then_some((distance, light))
        })
        .collect();
    // Lights of a frame are sorted by lane and the sort is stable, which breaks ties by lane id.
    lights.sort_by(|a, b| a.0.total_cmp(&b.0));
    lights
        .into_iter()
        .take(MAX_LIGHTS)
        .enumerate()
        .map(|(i, (_, light))| (i + 1, light))
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use gump_geometry::dvec2;

    #[test]
    fn a_smaller_radius_numbers_a_prefix() {
        let scenario = crate::fixture::scenario(
            "lane 1: 30,0 60,0
             lane 2: 10,0 60,0
             lane 3: 10,0 60,9
             lane 4: 90,0 99,0
             light 1 red: 30,0
             light 2 green: 10,0
             light 3 green: 10,0
             light 4 red: 90,0
             light 5 red: 1,0
             ego vehicle 0: 0,0",
        )
        .unwrap();
        let check = |radius: f64, expected: &[(usize, i64)]| {
            let found: Vec<_> = light_indices(&scenario.present(), dvec2(0.0, 0.0), radius)
                .into_iter()
                .map(|(i, light)| (i, light.lane.0))
                .collect();
            assert_eq!(found, expected);
        };
        // Lanes 2 and 3 start together; lane 5 is not in the map.
        check(100.0, &[(1, 2), (2, 3), (3, 1), (4, 4)]);
        check(50.0, &[(1, 2), (2, 3), (3, 1)]);
        check(5.0, &[]);
        let other = Frame::new(Vec::new(), scenario.log[0].lights()[3..].to_vec());
        let found = light_indices_of(&scenario.map, &other, dvec2(0.0, 0.0), 100.0);
        let found: Vec<_> = found
            .into_iter()
            .map(|(i, light)| (i, light.lane.0))
            .collect();
        assert_eq!(found, [(1, 4)], "another frame numbers its own lights");
    }
}
