//! Bearings, sideways gaps and wrapped angles.

use gump_geometry::{OrientedBox, Pose, wrap_angle};
use gump_nuplan::metrics::{bearing, is_ahead, is_behind, signed_lateral_gap};
use gump_scene::VehicleParameters;

use crate::common::{assert_close, golden, list, number, numbers};

#[test]
fn bearings_and_gaps_agree() {
    let golden = golden("path_geometry");
    let rows = list(&golden["relative"]["rows"]);
    assert_eq!(rows.len(), 30);
    for (i, row) in rows.iter().enumerate() {
        let pose = |value| {
            let [x, y, heading] = numbers(value)[..] else {
                panic!("{value}");
            };
            Pose::new(x, y, heading)
        };
        let (ego, agent) = (pose(&row[0]), pose(&row[1]));
        let what = format!("row {i}");
        let at = agent.position;
        assert_close(bearing(ego, at), number(&row[2]), 1e-8, &what);
        assert_eq!(is_ahead(ego, at), row[3].as_bool().unwrap(), "{what}");
        assert_eq!(is_behind(ego, at), row[4].as_bool().unwrap(), "{what}");
        let body = OrientedBox {
            pose: agent,
            length: 4.8,
            width: 2.0,
        };
        let gap = signed_lateral_gap(ego, VehicleParameters::PACIFICA.width, &body);
        // Headings are recorded to 9 decimals, 30 m away.
        assert_close(gap, number(&row[5]), 1e-7, &what);
    }
}

#[test]
fn angles_wrap_alike() {
    for row in list(&golden("path_geometry")["principal_value"]) {
        let [angle, expected] = numbers(row)[..] else {
            panic!("{row}");
        };
        assert_close(wrap_angle(angle), expected, 1e-8, "angle");
    }
}
