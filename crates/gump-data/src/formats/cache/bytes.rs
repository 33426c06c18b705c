//! Encoding of numbers, texts and columns as bytes, little-endian, and decoding.
//!
//! `log` and `map` define their meaning. A [`Decoder`] does not trust its input: it never allocates
//! more memory than the bytes present justify.

use std::fmt::Display;

use gump_geometry::{DVec2, Polygon, Polyline};

/// Why bytes are not what an [`Encoder`] wrote.
#[derive(Debug)]
pub(super) struct Damage {
    pub(super) expected: String,
    pub(super) found: String,
    /// Bytes from the start of what is decoded.
    pub(super) offset: usize,
}

pub(super) type Decoded<T> = Result<T, Damage>;

/// Tag of a column of numbers stored in single precision. Of this, [`DECIMALS`] and [`DOUBLE`], a
/// column gets the first that loses nothing.
///
/// Many formats state single precision or four decimals, and both take half the space.
const SINGLE: u8 = 1;
/// Whole multiples of 1 / [`DECIMAL`] as i32. Division rounds as reading the decimal did.
const DECIMALS: u8 = 2;
const DOUBLE: u8 = 3;
/// One number for all.
const SAME: u8 = 4;

const DECIMAL: f64 = 1e4;

/// Bytes being written.
#[derive(Default)]
pub(super) struct Encoder {
    pub(super) bytes: Vec<u8>,
}

impl Encoder {
    pub(super) fn byte(&mut self, value: u8) {
        self.bytes.push(value);
    }

    pub(super) fn flag(&mut self, value: bool) {
        self.byte(value.into());
    }

    /// A count or index, seven bits a byte.
    pub(super) fn count(&mut self, value: usize) {
        let mut rest = value as u64;
        while rest >= 0x80 {
            self.byte(rest as u8 | 0x80);
            rest >>= 7;
        }
        self.byte(rest as u8);
    }

    pub(super) fn crc(&mut self, value: u32) {
        self.bytes.extend(value.to_le_bytes());
    }

    pub(super) fn id(&mut self, value: i64) {
        self.bytes.extend(value.to_le_bytes());
    }

    pub(super) fn ids(&mut self, values: impl ExactSizeIterator<Item = i64>) {
        self.count(values.len());
        values.for_each(|id| self.id(id));
    }

    pub(super) fn number(&mut self, value: f64) {
        self.bytes.extend(value.to_le_bytes());
    }

    pub(super) fn text(&mut self, value: &str) {
        self.count(value.len());
        self.bytes.extend(value.as_bytes());
    }

    /// An optional value: a flag, then the value if there is one.
    pub(super) fn option<T>(&mut self, value: Option<T>, write: impl FnOnce(&mut Self, T)) {
        self.flag(value.is_some());
        if let Some(value) = value {
            write(self, value);
        }
    }

    /// The place of `value` in a table of all there are.
    pub(super) fn variant<T: PartialEq>(&mut self, all: &[T], value: &T) {
        let place = all.iter().position(|one| one == value);
        self.byte(place.expect("the table names every variant") as u8);
    }

    /// A column whose length the reader knows.
    pub(super) fn numbers(&mut self, values: impl Iterator<Item = f64> + Clone) {
        let same = |a: f64, b: f64| a.to_bits() == b.to_bits();
        if values.clone().all(|v| same(f64::from(v as f32), v)) {
            self.byte(SINGLE);
            values.for_each(|v| self.bytes.extend((v as f32).to_le_bytes()));
        } else if values
            .clone()
            .all(|v| same(f64::from(decimals(v)) / DECIMAL, v))
        {
            self.byte(DECIMALS);
            values.for_each(|v| self.bytes.extend(decimals(v).to_le_bytes()));
        } else {
            self.byte(DOUBLE);
            values.for_each(|v| self.bytes.extend(v.to_le_bytes()));
        }
    }

    /// A column whose length the reader knows, and which is often one number over and over.
    pub(super) fn even_numbers(&mut self, values: impl Iterator<Item = f64> + Clone) {
        let bits = values.clone().map(f64::to_bits);
        let first = bits.clone().next();
        if let Some(first) = first.filter(|first| bits.clone().all(|b| b == *first)) {
            self.byte(SAME);
            self.bytes.extend(first.to_le_bytes());
        } else {
            self.numbers(values);
        }
    }

    pub(super) fn points(&mut self, points: &[DVec2]) {
        self.count(points.len());
        self.numbers(points.iter().map(|p| p.x));
        self.numbers(points.iter().map(|p| p.y));
    }

    pub(super) fn polygon(&mut self, polygon: &Polygon) {
        self.points(polygon.ring());
        self.count(polygon.holes().len());
        polygon.holes().iter().for_each(|hole| self.points(hole));
    }
}

fn decimals(value: f64) -> i32 {
    // Saturates beyond 214,748 m, which the caller's comparison then refuses.
    (value * DECIMAL).round() as i32
}

/// Bytes being read.
pub(super) struct Decoder<'a> {
    bytes: &'a [u8],
    at: usize,
}

impl<'a> Decoder<'a> {
    pub(super) fn new(bytes: &'a [u8]) -> Self {
        Self { bytes, at: 0 }
    }

    /// Says that something else was expected at the place just read.
    pub(super) fn damage(&self, expected: impl Into<String>, found: &dyn Display) -> Damage {
        Damage {
            expected: expected.into(),
            found: found.to_string(),
            offset: self.at,
        }
    }

    /// True if nothing is left.
    pub(super) fn is_at_end(&self) -> bool {
        self.at == self.bytes.len()
    }

    /// Checks that nothing is left over.
    pub(super) fn end(&self) -> Decoded<()> {
        match self.bytes.len() - self.at {
            0 => Ok(()),
            rest => Err(self.damage("the end", &format!("{rest} more bytes"))),
        }
    }

    pub(super) fn take(&mut self, n: usize) -> Decoded<&'a [u8]> {
        let rest = &self.bytes[self.at..];
        let Some(taken) = rest.get(..n) else {
            return Err(self.damage(format!("{n} more bytes"), &rest.len()));
        };
        self.at += n;
        Ok(taken)
    }

    fn array<const N: usize>(&mut self) -> Decoded<[u8; N]> {
        let mut array = [0; N];
        array.copy_from_slice(self.take(N)?);
        Ok(array)
    }

    pub(super) fn byte(&mut self) -> Decoded<u8> {
        Ok(self.array::<1>()?[0])
    }

    pub(super) fn flag(&mut self) -> Decoded<bool> {
        match self.byte()? {
            0 => Ok(false),
            1 => Ok(true),
            other => Err(self.damage("0 or 1", &other)),
        }
    }

    pub(super) fn count(&mut self) -> Decoded<usize> {
        let mut value = 0_u64;
        for shift in (0..64).step_by(7) {
            let byte = self.byte()?;
            let bits = u64::from(byte & 0x7f);
            if (bits << shift) >> shift != bits {
                break;
            }
            value |= bits << shift;
            if byte < 0x80 {
                return usize::try_from(value).map_err(|_| self.damage("a count", &value));
            }
        }
        Err(self.damage("a count", &"one beyond 64 bits"))
    }

    /// A number of things that take at least `bytes` each, no more than there can be.
    pub(super) fn count_of(&mut self, bytes: usize) -> Decoded<usize> {
        let n = self.count()?;
        let most = (self.bytes.len() - self.at) / bytes;
        if n > most {
            return Err(self.damage(format!("a count of at most {most}"), &n));
        }
        Ok(n)
    }

    pub(super) fn crc(&mut self) -> Decoded<u32> {
        Ok(u32::from_le_bytes(self.array()?))
    }

    pub(super) fn long(&mut self) -> Decoded<u64> {
        Ok(u64::from_le_bytes(self.array()?))
    }

    pub(super) fn id(&mut self) -> Decoded<i64> {
        Ok(i64::from_le_bytes(self.array()?))
    }

    pub(super) fn ids<T>(&mut self, of: fn(i64) -> T) -> Decoded<Vec<T>> {
        self.list(8, |decoder| Ok(of(decoder.id()?)))
    }

    pub(super) fn number(&mut self) -> Decoded<f64> {
        Ok(f64::from_le_bytes(self.array()?))
    }

    pub(super) fn text(&mut self) -> Decoded<&'a str> {
        let n = self.count()?;
        let bytes = self.take(n)?;
        std::str::from_utf8(bytes).map_err(|_| self.damage("text in UTF-8", &"other bytes"))
    }

    pub(super) fn option<T>(
        &mut self,
        read: impl FnOnce(&mut Self) -> Decoded<T>,
    ) -> Decoded<Option<T>> {
        self.flag()?.then(|| read(self)).transpose()
    }

    pub(super) fn variant<T: Copy>(&mut self, all: &[T]) -> Decoded<T> {
        let place = self.byte()?;
        let found = all.get(usize::from(place)).copied();
        found.ok_or_else(|| self.damage(format!("a number below {}", all.len()), &place))
    }

    /// A list of things that take at least `bytes` each.
    pub(super) fn list<T>(
        &mut self,
        bytes: usize,
        mut read: impl FnMut(&mut Self) -> Decoded<T>,
    ) -> Decoded<Vec<T>> {
        let n = self.count_of(bytes)?;
        (0..n).map(|_| read(self)).collect()
    }

    /// A column of `n` numbers, each of which takes room.
    pub(super) fn numbers(&mut self, n: usize) -> Decoded<Vec<f64>> {
        let kind = self.byte()?;
        self.column(kind, n)
    }

    /// A column of `n` numbers that may be stored as one; `n` must be accounted for elsewhere.
    pub(super) fn even_numbers(&mut self, n: usize) -> Decoded<Vec<f64>> {
        match self.byte()? {
            SAME => Ok(vec![self.number()?; n]),
            kind => self.column(kind, n),
        }
    }

    fn column(&mut self, kind: u8, n: usize) -> Decoded<Vec<f64>> {
        match kind {
            SINGLE => self.values(n, |bytes| f64::from(f32::from_le_bytes(bytes))),
            DECIMALS => self.values(n, |bytes| f64::from(i32::from_le_bytes(bytes)) / DECIMAL),
            DOUBLE => self.values(n, f64::from_le_bytes),
            other => Err(self.damage("a kind of column", &other)),
        }
    }

    fn values<const N: usize>(&mut self, n: usize, of: fn([u8; N]) -> f64) -> Decoded<Vec<f64>> {
        let bytes = self.take(n.saturating_mul(N))?;
        let (values, _) = bytes.as_chunks::<N>();
        Ok(values.iter().map(|value| of(*value)).collect())
    }

    pub(super) fn points(&mut self) -> Decoded<Vec<DVec2>> {
        let n = self.count()?;
        let (x, y) = (self.numbers(n)?, self.numbers(n)?);
        Ok(x.into_iter().zip(y).map(DVec2::from).collect())
    }

    pub(super) fn polyline(&mut self) -> Decoded<Polyline> {
        let line = Polyline::new(self.points()?);
        line.ok_or_else(|| self.damage("a line of points", &"none"))
    }

    pub(super) fn polygon(&mut self) -> Decoded<Polygon> {
        let ring = self.ring()?;
        let holes = self.list(1, Self::ring)?;
        let polygon = Polygon::with_holes(ring, holes);
        polygon.ok_or_else(|| self.damage("a polygon", &"fewer than three corners"))
    }

    /// A ring with its first corner repeated at the end, where a polygon drops it: a ring whose
    /// corners happen to repeat comes back as it was.
    fn ring(&mut self) -> Decoded<Vec<DVec2>> {
        let mut ring = self.points()?;
        ring.extend(ring.first().copied());
        Ok(ring)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn columns_come_back_to_the_bit_in_the_least_room() {
        let columns: [(&[f64], u8, usize); 5] = [
            (&[0.5, -0.0, f64::INFINITY], SINGLE, 4),
            (&[12_345.678_9, -0.000_1, 0.1], DECIMALS, 4),
            (&[0.1, -0.0], DOUBLE, 8),
            (&[1.0 / 3.0, 0.25], DOUBLE, 8),
            (&[214_748.364_8, 0.1], DOUBLE, 8),
        ];
        for (column, kind, bytes) in columns {
            let mut encoder = Encoder::default();
            encoder.numbers(column.iter().copied());
            assert_eq!(encoder.bytes[0], kind, "{column:?}");
            assert_eq!(encoder.bytes.len(), 1 + column.len() * bytes);
            let mut decoder = Decoder::new(&encoder.bytes);
            let found = decoder.numbers(column.len()).unwrap();
            let bits = |values: &[f64]| values.iter().map(|v| v.to_bits()).collect::<Vec<_>>();
            assert_eq!(bits(&found), bits(column));
            decoder.end().unwrap();
        }
    }

    #[test]
    fn counts_come_back_and_false_ones_are_refused() {
        for n in [0, 1, 127, 128, 16_384, usize::MAX] {
            let mut encoder = Encoder::default();
            encoder.count(n);
            assert_eq!(Decoder::new(&encoder.bytes).count().unwrap(), n);
        }
        assert!(Decoder::new(&[0xff; 11]).count().is_err());
        let mut encoder = Encoder::default();
        encoder.count(1 << 40);
        assert!(Decoder::new(&encoder.bytes).count_of(1).is_err());
        assert!(Decoder::new(&encoder.bytes).points().is_err());
    }

    #[test]
    fn a_polygon_with_a_repeated_corner_comes_back() {
        let ring = [(0.0, 0.0), (4.0, 0.0), (0.0, 4.0), (0.0, 0.0), (0.0, 0.0)];
        let ring = ring.map(|(x, y)| DVec2::new(x, y)).to_vec();
        let hole = [(1.0, 1.0), (2.0, 1.0), (1.0, 2.0)].map(|(x, y)| DVec2::new(x, y));
        let polygon = Polygon::with_holes(ring, vec![hole.to_vec()]).unwrap();
        let mut encoder = Encoder::default();
        encoder.polygon(&polygon);
        assert_eq!(Decoder::new(&encoder.bytes).polygon().unwrap(), polygon);
    }
}
