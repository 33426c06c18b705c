//! Two cars at a crossing: which one is first at the point where their paths meet, and by how much.
//!
//! Post-encroachment time is how long that place lies empty in between; below a second or two it
//! counts as a conflict. `cargo run -p gump-geometry --example conflict_point`

use gump_geometry::{OrientedBox, Polygon, Polyline, dvec2};

/// A car of 4.8 x 2 m that drives along a path at constant speed.
struct Car {
    path: Polyline,
    speed: f64,
}

impl Car {
    fn at(&self, time: f64) -> OrientedBox {
        OrientedBox {
            pose: self.path.pose_at(self.speed * time),
            length: 4.8,
            width: 2.0,
        }
    }

    /// Times at which it enters and leaves an area, seconds; `None` if it never touches it.
    fn within(&self, area: &Polygon) -> Option<(f64, f64)> {
        let mut inside = (0..400).map(|i| f64::from(i) * 0.05).filter(|time| {
            let footprint = Polygon::new(self.at(*time).corners().to_vec());
            footprint.is_some_and(|footprint| footprint.intersects(area))
        });
        let first = inside.next()?;
        Some((first, inside.next_back().unwrap_or(first)))
    }
}

fn main() -> Result<(), &'static str> {
    let east = Polyline::new(vec![dvec2(-60.0, 0.0), dvec2(60.0, 0.0)]).ok_or("two points")?;
    let bend = vec![dvec2(20.0, -60.0), dvec2(10.0, -20.0), dvec2(10.0, 60.0)];
    let north = Polyline::new(bend).ok_or("two points")?;
    let swept = |path: &Polyline| path.ribbon(2.0).ok_or("a ribbon has an area");

    for speed in [8.0, 10.0, 12.0, 14.0] {
        let (path, other) = (east.clone(), north.clone());
        let (own, other) = (Car { path, speed: 11.0 }, Car { path: other, speed });
        let (enter, leave) = own.within(&swept(&north)?).ok_or("the paths cross")?;
        let (their_enter, their_leave) = other.within(&swept(&east)?).ok_or("the paths cross")?;
        let empty = (their_enter - leave).max(enter - their_leave);
        let times = (0..200).map(|i| f64::from(i) * 0.05);
        let gaps = times.map(|time| own.at(time).signed_distance(&other.at(time)));
        let gap = gaps.fold(f64::INFINITY, f64::min);
        println!("11 and {speed:2} m/s: {empty:+.2} s in between, never closer than {gap:+.2} m");
    }
    Ok(())
}
