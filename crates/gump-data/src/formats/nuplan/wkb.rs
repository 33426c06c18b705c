//! Decoding of shapes in a GeoPackage: a header, then well-known binary.
//!
//! Coordinates are not interpreted. Start with [`parse`].
//!
//! Source: OGC 12-128r19 (GeoPackage 1.4), clause 2.1.3; OGC 06-103r4 (simple features), clause 8.

/// A shape in the plane; further dimensions are left out.
#[derive(Clone, Debug, PartialEq)]
pub(super) enum Shape {
    Points(Vec<[f64; 2]>),
    /// Lines, each of any number of points.
    Lines(Vec<Vec<[f64; 2]>>),
    /// Polygons, each an outer ring and its holes.
    Polygons(Vec<Vec<Vec<[f64; 2]>>>),
}

/// Collections do not nest deeper than this in sound files.
const MAX_DEPTH: usize = 4;

/// Reads the content of a geometry column.
///
/// Error: a sentence of what was expected at which byte.
pub(super) fn parse(blob: &[u8]) -> Result<Shape, String> {
    let mut bytes = Bytes { blob, at: 0 };
    if bytes.take(2)? != b"GP" {
        return Err("expected the letters GP at byte 0".into());
    }
    let (_version, flags) = (bytes.byte()?, bytes.byte()?);
    let _srs_id = bytes.take(4)?;
    let envelope = match flags >> 1 & 0b111 {
        0 => 0,
        1 => 32,
        2 | 3 => 48,
        4 => 64,
        kind => return Err(format!("expected an envelope of kind 0 to 4, found {kind}")),
    };
    bytes.take(envelope)?;
    let shape = bytes.shape(0)?;
    match bytes.blob.len() - bytes.at {
        0 => Ok(shape),
        rest => Err(format!(
            "expected the end at byte {}, found {rest} more bytes",
            bytes.at
        )),
    }
}

struct Bytes<'a> {
    blob: &'a [u8],
    at: usize,
}

impl<'a> Bytes<'a> {
    fn take(&mut self, n: usize) -> Result<&'a [u8], String> {
        let rest = &self.blob[self.at..];
        let Some(taken) = rest.get(..n) else {
            let (at, found) = (self.at, rest.len());
            return Err(format!("expected {n} bytes at byte {at}, found {found}"));
        };
        self.at += n;
        Ok(taken)
    }

    fn byte(&mut self) -> Result<u8, String> {
        self.take(1).map(|bytes| bytes[0])
    }

    fn number(&mut self, little: bool) -> Result<u32, String> {
        let mut bytes = [0; 4];
        bytes.copy_from_slice(self.take(4)?);
        Ok(if little {
            u32::from_le_bytes(bytes)
        } else {
            u32::from_be_bytes(bytes)
        })
    }

    fn real(&mut self, little: bool) -> Result<f64, String> {
        let mut bytes = [0; 8];
        bytes.copy_from_slice(self.take(8)?);
        Ok(if little {
            f64::from_le_bytes(bytes)
        } else {
            f64::from_be_bytes(bytes)
        })
    }

    fn shape(&mut self, depth: usize) -> Result<Shape, String> {
        let at = self.at;
        let little = self.byte()? == 1;
        let code = self.number(little)?;
        let (kind, dimensions) = kind(code);
        let ring = |bytes: &mut Self| bytes.points(little, dimensions);
        match kind {
            1 => Ok(Shape::Points(vec![self.point(little, dimensions)?])),
            2 => Ok(Shape::Lines(vec![ring(self)?])),
            3 => Ok(Shape::Polygons(vec![self.many(little, ring)?])),
            4..=6 if depth < MAX_DEPTH => {
                let parts = self.many(little, |bytes| bytes.shape(depth + 1))?;
                join(kind, parts).ok_or_else(|| format!("expected parts of one kind at byte {at}"))
            }
            _ => Err(format!(
                "expected a point, line or polygon at byte {at}, found shape {code}"
            )),
        }
    }

    fn points(&mut self, little: bool, dimensions: usize) -> Result<Vec<[f64; 2]>, String> {
        self.many(little, |bytes| bytes.point(little, dimensions))
    }

    fn point(&mut self, little: bool, dimensions: usize) -> Result<[f64; 2], String> {
        let point = [self.real(little)?, self.real(little)?];
        self.take(8 * (dimensions - 2))?;
        Ok(point)
    }

    /// As many parts as the count states. Nothing is reserved: a false count ends with the bytes.
    fn many<T>(
        &mut self,
        little: bool,
        mut part: impl FnMut(&mut Self) -> Result<T, String>,
    ) -> Result<Vec<T>, String> {
        let n = self.number(little)?;
        (0..n).map(|_| part(self)).collect()
    }
}

/// The kind without its dimensions, and how many numbers a point has.
fn kind(code: u32) -> (u32, usize) {
    // Two spellings are in use: thousands (ISO) and high bits (EWKB).
    let (high, low) = (code >> 30, code & 0x0fff_ffff);
    let (kind, iso) = (low % 1000, low / 1000);
    let extra = match (high, iso) {
        (0, 0) => 0,
        (0b11, 0) | (0, 3) => 2,
        (0b10 | 0b01, 0) | (0, 1 | 2) => 1,
        _ => return (u32::MAX, 2),
    };
    (kind, 2 + extra)
}

/// Parts of one kind as one shape; `None` if they are not of `kind` (4, 5 or 6).
fn join(kind: u32, parts: Vec<Shape>) -> Option<Shape> {
    let (mut points, mut lines, mut polygons) = (Vec::new(), Vec::new(), Vec::new());
    for part in parts {
        match (kind, part) {
            (4, Shape::Points(part)) => points.extend(part),
            (5, Shape::Lines(part)) => lines.extend(part),
            (6, Shape::Polygons(part)) => polygons.extend(part),
            _ => return None,
        }
    }
    Some(match kind {
        4 => Shape::Points(points),
        5 => Shape::Lines(lines),
        _ => Shape::Polygons(polygons),
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A blob with a header without envelope around `body`.
    fn blob(body: &[u8]) -> Vec<u8> {
        [b"GP\x00\x01\xe6\x10\x00\x00".as_slice(), body].concat()
    }

    fn reals(values: &[f64]) -> Vec<u8> {
        values.iter().flat_map(|v| v.to_le_bytes()).collect()
    }

    fn part(code: u32, body: &[u8]) -> Vec<u8> {
        [&[1], code.to_le_bytes().as_slice(), body].concat()
    }

    fn counted(n: u32, body: &[u8]) -> Vec<u8> {
        [n.to_le_bytes().as_slice(), body].concat()
    }

    #[test]
    fn points_lines_and_polygons_are_read() {
        let point = part(1, &reals(&[3.0, 4.0]));
        assert_eq!(parse(&blob(&point)), Ok(Shape::Points(vec![[3.0, 4.0]])));
        let line = part(2, &counted(2, &reals(&[0.0, 1.0, 2.0, 3.0])));
        let expected = vec![[0.0, 1.0], [2.0, 3.0]];
        assert_eq!(parse(&blob(&line)), Ok(Shape::Lines(vec![expected])));
        let ring = counted(3, &reals(&[0.0, 0.0, 1.0, 0.0, 0.0, 1.0]));
        let corners = vec![[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]];
        let polygon = part(3, &counted(2, &[ring.clone(), ring].concat()));
        let with_hole = vec![corners.clone(), corners];
        assert_eq!(
            parse(&blob(&polygon)),
            Ok(Shape::Polygons(vec![with_hole.clone()]))
        );
        let two = part(6, &counted(2, &[polygon.clone(), polygon].concat()));
        let expected = Shape::Polygons(vec![with_hole.clone(), with_hole]);
        assert_eq!(parse(&blob(&two)), Ok(expected));
    }

    #[test]
    fn further_dimensions_are_left_out_in_both_spellings() {
        for code in [1002, 0x8000_0002] {
            let line = part(code, &counted(1, &reals(&[1.0, 2.0, 99.0])));
            assert_eq!(
                parse(&blob(&line)),
                Ok(Shape::Lines(vec![vec![[1.0, 2.0]]]))
            );
        }
        let all = part(3001, &reals(&[1.0, 2.0, 98.0, 99.0]));
        assert_eq!(parse(&blob(&all)), Ok(Shape::Points(vec![[1.0, 2.0]])));
    }

    #[test]
    fn either_byte_order_will_do() {
        let mut body = vec![0, 0, 0, 0, 1];
        body.extend([5.0f64, 6.0].iter().flat_map(|v| v.to_be_bytes()));
        assert_eq!(parse(&blob(&body)), Ok(Shape::Points(vec![[5.0, 6.0]])));
    }

    #[test]
    fn damage_is_named_with_its_place() {
        let check = |blob: &[u8], expected: &str| assert_eq!(parse(blob).unwrap_err(), expected);
        check(b"", "expected 2 bytes at byte 0, found 0");
        check(b"XX", "expected the letters GP at byte 0");
        check(
            b"GP\x00\x0f\x00\x00\x00\x00",
            "expected an envelope of kind 0 to 4, found 7",
        );
        let false_count = part(2, &counted(u32::MAX, &reals(&[0.0, 1.0])));
        check(&blob(&false_count), "expected 8 bytes at byte 33, found 0");
        check(
            &blob(&part(9, &[])),
            "expected a point, line or polygon at byte 8, found shape 9",
        );
        let rest = [part(1, &reals(&[0.0, 0.0])), vec![7]].concat();
        check(
            &blob(&rest),
            "expected the end at byte 29, found 1 more bytes",
        );
    }

    #[test]
    fn nesting_has_an_end() {
        let mut body = part(4, &counted(0, &[]));
        for _ in 0..100 {
            body = part(4, &counted(1, &body));
        }
        assert!(parse(&blob(&body)).unwrap_err().contains("found shape 4"));
    }
}
