//! Lanes controlled by lights, where a format states only positions.

use gump_geometry::{DVec2, PointIndex};
use gump_scene::{LaneId, Light, MapGraph};

use crate::ReadReport;

/// A controlled lane starts this near to where vehicles stop, metres: lines lie before the
/// crosswalk, lanes may begin behind it. Chosen by hand.
const MAX_DISTANCE: f64 = 6.0;

/// Attaches lights whose lane is not in the map to the lane that starts nearest to them.
pub(super) fn infer(lights: &mut [(usize, Light)], map: &MapGraph, report: &mut ReadReport) {
    if lights
        .iter()
        .all(|(_, light)| map.lane(light.lane).is_some())
    {
        return;
    }
    let lanes = map.lanes();
    let starts = PointIndex::new(lanes.iter().map(|lane| lane.centerline.points()[0]));
    let mut last: Option<(LaneId, DVec2, Option<LaneId>)> = None;
    for (_, light) in lights.iter_mut() {
        let Some(stop) = light.stop_point.filter(|_| map.lane(light.lane).is_none()) else {
            continue;
        };
        // Lights stay where they are: usually the answer is that of the step before.
        let again = last.filter(|(lane, at, _)| *lane == light.lane && *at == stop);
        let found = again.map_or_else(
            || {
                let nearest = starts.nearest(stop, 1).next();
                let found = nearest.filter(|(_, distance)| *distance <= MAX_DISTANCE);
                report.infer(
                    "lane of a light from its place",
                    usize::from(found.is_some()),
                );
                found.map(|(i, _)| lanes[i].id)
            },
            |(_, _, found)| found,
        );
        last = Some((light.lane, stop, found));
        light.lane = found.unwrap_or(light.lane);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use gump_geometry::dvec2;
    use gump_scene::LightState;

    #[test]
    fn the_lane_that_starts_nearest_is_taken() {
        let scenario = gump_scene::fixture::scenario(
            "lane 1: 0,0 50,0\nlane 2: 50,0 90,0\nego vehicle 0: 9,0 velocity 5,0",
        )
        .unwrap();
        let light = |lane, x| {
            let light = Light {
                lane: LaneId(lane),
                state: LightState::Red,
                stop_point: Some(dvec2(x, 1.0)),
            };
            (0, light)
        };
        let mut lights = vec![light(-7, 49.0), light(1, 49.0), light(-8, 70.0)];
        let mut report = ReadReport::default();
        infer(&mut lights, &scenario.map, &mut report);
        let lanes: Vec<_> = lights.iter().map(|(_, light)| light.lane.0).collect();
        assert_eq!(lanes, [2, 1, -8], "known lanes and lights far off stay");
        assert_eq!(report.inferred["lane of a light from its place"], 1);
    }
}
