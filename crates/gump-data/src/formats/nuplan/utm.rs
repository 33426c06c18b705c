//! Projection from longitude and latitude to the plane of nuPlan's logs.

use gump_geometry::{DVec2, dvec2};

/// Semi-major axis and flattening of the WGS 84 ellipsoid, metres and a ratio.
const SEMI_MAJOR: f64 = 6_378_137.0;
const FLATTENING: f64 = 1.0 / 298.257_223_563;
/// Scale on the central meridian.
const SCALE: f64 = 0.9996;
/// Easting of the central meridian and northing of the equator on the southern half, metres.
const FALSE_EASTING: f64 = 500_000.0;
const FALSE_NORTHING_SOUTH: f64 = 10_000_000.0;

/// One zone of the universal transverse Mercator projection on WGS 84.
///
/// Source: the series of Krüger 1912 to the sixth order, with the coefficients of Karney 2011,
/// "Transverse Mercator with an accuracy of a few nanometers"; agrees with PROJ to 1e-6 m.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Utm {
    /// Longitude of the central meridian, radians.
    central_meridian: f64,
    false_northing: f64,
    /// Radius of the sphere of the same meridian length, times the scale, metres.
    radius: f64,
    eccentricity: f64,
    coefficients: [f64; 6],
}

impl Utm {
    /// The zone with this EPSG code: 32601 to 32660 north, 32701 to 32760 south; `None` for other
    /// codes.
    pub fn from_epsg(code: i64) -> Option<Self> {
        let (zone, false_northing) = match code {
            32601..=32660 => (code - 32600, 0.0),
            32701..=32760 => (code - 32700, FALSE_NORTHING_SOUTH),
            _ => return None,
        };
        let n = FLATTENING / (2.0 - FLATTENING);
        let meridian = (1.0 + n.powi(2) / 4.0 + n.powi(4) / 64.0 + n.powi(6) / 256.0) / (1.0 + n);
        Some(Self {
            central_meridian: (6.0 * zone as f64 - 183.0).to_radians(),
            false_northing,
            radius: SCALE * SEMI_MAJOR * meridian,
            eccentricity: (FLATTENING * (2.0 - FLATTENING)).sqrt(),
            coefficients: coefficients(n),
        })
    }

    /// Easting and northing, metres, of a place given in degrees.
    pub fn project(&self, longitude_deg: f64, latitude_deg: f64) -> DVec2 {
        let lambda = longitude_deg.to_radians() - self.central_meridian;
        // The latitude on the conformal sphere, as its tangent.
        let tau = latitude_deg.to_radians().tan();
        let secant = tau.hypot(1.0);
        let sigma = (self.eccentricity * (self.eccentricity * tau / secant).atanh()).sinh();
        let tau = tau * sigma.hypot(1.0) - sigma * secant;
        // Transverse Mercator of the sphere, then the series to the ellipsoid.
        let xi = tau.atan2(lambda.cos());
        let eta = (lambda.sin() / tau.hypot(lambda.cos())).asinh();
        let mut plane = dvec2(eta, xi);
        for (j, coefficient) in (1..).zip(self.coefficients) {
            let twice = 2.0 * f64::from(j);
            let east = (twice * xi).cos() * (twice * eta).sinh();
            let north = (twice * xi).sin() * (twice * eta).cosh();
            plane += dvec2(east, north) * coefficient;
        }
        plane * self.radius + dvec2(FALSE_EASTING, self.false_northing)
    }
}

/// Krüger's coefficients of the forward series, for the third flattening `n`.
fn coefficients(n: f64) -> [f64; 6] {
    // Row j holds the factors of n^j, n^(j+1), ... n^6.
    const ROWS: [&[f64]; 6] = [
        &[
            1.0 / 2.0,
            -2.0 / 3.0,
            5.0 / 16.0,
            41.0 / 180.0,
            -127.0 / 288.0,
            7891.0 / 37800.0,
        ],
        &[
            13.0 / 48.0,
            -3.0 / 5.0,
            557.0 / 1440.0,
            281.0 / 630.0,
            -1_983_433.0 / 1_935_360.0,
        ],
        &[
            61.0 / 240.0,
            -103.0 / 140.0,
            15061.0 / 26880.0,
            167_603.0 / 181_440.0,
        ],
        &[
            49561.0 / 161_280.0,
            -179.0 / 168.0,
            6_601_661.0 / 7_257_600.0,
        ],
        &[34729.0 / 80640.0, -3_418_889.0 / 1_995_840.0],
        &[212_378_941.0 / 319_334_400.0],
    ];
    let mut result = [0.0; 6];
    for (j, row) in ROWS.iter().enumerate() {
        let terms = row.iter().zip(j as i32 + 1..);
        result[j] = terms.map(|(factor, power)| factor * n.powi(power)).sum();
    }
    result
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_central_meridian_meets_the_equator_at_the_false_origin() {
        let zone = Utm::from_epsg(32611).unwrap();
        let origin = zone.project(-117.0, 0.0);
        assert!(origin.distance(dvec2(FALSE_EASTING, 0.0)) < 1e-9);
        let south = Utm::from_epsg(32711).unwrap().project(-117.0, 0.0);
        assert_eq!(south.y - origin.y, FALSE_NORTHING_SOUTH);
    }

    #[test]
    fn other_projections_are_not_known() {
        for code in [4326, 32600, 32661, 32761, -1] {
            assert_eq!(Utm::from_epsg(code), None, "{code}");
        }
    }
}
