//! Reading of an XML file element by element, with attributes by name.
//!
//! Ends of elements and text are skipped: SUMO states everything in attributes, and the order of
//! elements determines what belongs together.

use std::borrow::Cow;
use std::io::BufReader;
use std::path::{Path, PathBuf};
use std::str::FromStr;

use quick_xml::XmlVersion;
use quick_xml::events::{BytesStart, Event};
use quick_xml::reader::Reader;

use crate::DataError;
use crate::io::stream::{self, Stream};

/// An XML file being read.
pub(super) struct Xml {
    reader: Reader<BufReader<Stream>>,
    buffer: Vec<u8>,
    path: PathBuf,
}

/// The start of an element.
pub(super) struct Element<'a> {
    start: BytesStart<'a>,
    offset: u64,
    path: &'a Path,
}

impl Xml {
    /// Opens a file, plain or gzip.
    ///
    /// Error: as [`stream::open`].
    pub(super) fn open(path: &Path) -> Result<Self, DataError> {
        Ok(Self {
            reader: Reader::from_reader(BufReader::new(stream::open(path)?)),
            buffer: Vec::new(),
            path: path.into(),
        })
    }

    /// The next element; `None` at the end of the file.
    ///
    /// Error: [`DataError::Xml`] for a file that is not well formed.
    pub(super) fn next(&mut self) -> Result<Option<Element<'_>>, DataError> {
        loop {
            self.buffer.clear();
            let offset = self.reader.buffer_position();
            // Asked twice because a borrowed event cannot be handed out from within a loop.
            let kind = self.reader.read_event_into(&mut self.buffer);
            match kind {
                Ok(Event::Eof) => return Ok(None),
                Ok(Event::Start(start) | Event::Empty(start)) => {
                    let start = start.into_owned();
                    let path = self.path.as_path();
                    return Ok(Some(Element {
                        start,
                        offset,
                        path,
                    }));
                }
                Ok(_) => {}
                Err(error) => return Err(xml_error(error.to_string(), offset, &self.path)),
            }
        }
    }

    /// The position of the reader, bytes from the start of the content.
    pub(super) fn offset(&self) -> u64 {
        self.reader.buffer_position()
    }
}

impl Element<'_> {
    /// The element's name.
    pub(super) fn name(&self) -> &str {
        self.start.name().into_inner()
    }

    /// An attribute's value.
    ///
    /// Error: [`DataError::Xml`] for attributes that are not well formed.
    pub(super) fn get(&self, name: &str) -> Result<Option<Cow<'_, str>>, DataError> {
        let attribute = self.start.try_get_attribute(name);
        let attribute = attribute.map_err(|error| self.error(&error.to_string()))?;
        attribute
            .map(|attribute| {
                attribute
                    .normalized_value(XmlVersion::Implicit1_0)
                    .map_err(|error| self.error(&error.to_string()))
            })
            .transpose()
    }

    /// The value of an attribute that must be there.
    ///
    /// Error: [`DataError::Xml`].
    pub(super) fn need(&self, name: &str) -> Result<Cow<'_, str>, DataError> {
        self.get(name)?
            .ok_or_else(|| self.error(&format!("expected the attribute \"{name}\", found none")))
    }

    /// A number, if the attribute is there.
    ///
    /// Error: [`DataError::Xml`] for something else than a (finite) number.
    pub(super) fn number<T: FromStr>(&self, name: &str) -> Result<Option<T>, DataError> {
        self.get(name)?
            .map(|text| self.parse(name, &text))
            .transpose()
    }

    /// A number that must be there.
    ///
    /// Error: [`DataError::Xml`].
    pub(super) fn need_number<T: FromStr>(&self, name: &str) -> Result<T, DataError> {
        let text = self.need(name)?;
        self.parse(name, &text)
    }

    /// The points of a shape like `1.0,2.0 3.0,4.0,0.5`, z being 0 where none is given.
    ///
    /// Error: [`DataError::Xml`].
    pub(super) fn shape(&self, name: &str) -> Result<Vec<[f64; 3]>, DataError> {
        let text = self.get(name)?.unwrap_or_default();
        let point = |word: &str| {
            let mut numbers = word
                .split(',')
                .map(|number| self.parse::<f64>(name, number));
            let mut next = || numbers.next().transpose();
            match (next()?, next()?, next()?) {
                (Some(x), Some(y), z) => Ok([x, y, z.unwrap_or(0.0)]),
                _ => Err(self.error(&format!("expected x,y in \"{name}\", found {word}"))),
            }
        };
        text.split_whitespace().map(point).collect()
    }

    /// An error at this element.
    pub(super) fn error(&self, problem: &str) -> DataError {
        let problem = format!("<{}>: {problem}", self.name());
        xml_error(problem, self.offset, self.path)
    }

    fn parse<T: FromStr>(&self, name: &str, text: &str) -> Result<T, DataError> {
        let text = text.trim();
        let is_number = !matches!(
            text.to_ascii_lowercase().trim_start_matches(['+', '-']),
            "nan" | "inf" | "infinity"
        );
        let parsed = if is_number { text.parse().ok() } else { None };
        parsed.ok_or_else(|| self.error(&format!("expected a number in \"{name}\", found {text}")))
    }
}

fn xml_error(problem: String, offset: u64, path: &Path) -> DataError {
    DataError::Xml {
        problem,
        offset,
        path: path.into(),
    }
}
