//! XML documents as a tree.
//!
//! Supports elements, attributes and plain text only, which the formats here use. Size, number of
//! elements and depth are bounded.

use std::path::Path;

use quick_xml::Reader;
use quick_xml::events::{BytesStart, Event};

use super::stream;
use crate::DataError;

/// The longest document that is read, bytes after unpacking: damaged files may unpack to anything.
const MAX_BYTES: u64 = 64 << 20;
/// The most elements of a document. An element takes about 100 bytes.
const MAX_ELEMENTS: usize = 4_000_000;
/// The deepest nesting; the formats here use eight.
const MAX_DEPTH: usize = 64;

/// An element with everything in it.
#[derive(Debug, Default)]
pub(crate) struct Element {
    pub(crate) name: Box<str>,
    attributes: Vec<(Box<str>, Box<str>)>,
    /// The text directly inside, trimmed.
    text: String,
    pub(crate) children: Vec<Element>,
}

impl Element {
    /// An attribute's value.
    pub(crate) fn attribute(&self, name: &str) -> Option<&str> {
        let found = self.attributes.iter().find(|(key, _)| &**key == name);
        found.map(|(_, value)| &**value)
    }

    /// An attribute as a whole number.
    pub(crate) fn id(&self, name: &str) -> Option<i64> {
        self.attribute(name)?.trim().parse().ok()
    }

    /// The first child of this name.
    pub(crate) fn child(&self, name: &str) -> Option<&Element> {
        self.children.iter().find(|child| &*child.name == name)
    }

    /// All children of this name, in order.
    pub(crate) fn all<'a>(&'a self, name: &'a str) -> impl Iterator<Item = &'a Element> {
        self.children
            .iter()
            .filter(move |child| &*child.name == name)
    }

    /// The element at the end of a path of first children.
    pub(crate) fn at(&self, path: &[&str]) -> Option<&Element> {
        path.iter()
            .try_fold(self, |element, name| element.child(name))
    }

    /// The text at the end of a path.
    pub(crate) fn text(&self, path: &[&str]) -> Option<&str> {
        self.at(path).map(|element| element.text.trim())
    }

    /// The number at the end of a path; NaN if there is none.
    pub(crate) fn number(&self, path: &[&str]) -> f64 {
        self.text(path)
            .and_then(|text| text.parse().ok())
            .unwrap_or(f64::NAN)
    }
}

/// Reads a document.
///
/// Error: those of opening, [`DataError::TooLarge`], [`DataError::Xml`] with the byte.
pub(crate) fn read(path: &Path, what: &'static str) -> Result<Element, DataError> {
    let bytes = stream::content(path, what, MAX_BYTES)?;
    parse(&bytes).map_err(|(found, offset)| DataError::Xml {
        problem: format!("expected {what}, found {found}"),
        offset,
        path: path.into(),
    })
}

/// The root element, or what is wrong and at which byte.
fn parse(bytes: &[u8]) -> Result<Element, (String, u64)> {
    let text = std::str::from_utf8(bytes).map_err(|error| {
        (
            "bytes that are not UTF-8".to_owned(),
            error.valid_up_to() as u64,
        )
    })?;
    let mut reader = Reader::from_str(text);
    // The open elements; the first holds the root.
    let mut open = vec![Element::default()];
    let mut n_elements = 0;
    loop {
        let event = reader.read_event();
        let offset = reader.buffer_position();
        let at = |found: String| (found, offset);
        match event.map_err(|error| at(error.to_string()))? {
            Event::Start(start) => {
                n_elements += 1;
                if open.len() > MAX_DEPTH {
                    return Err(at(format!("elements nested more than {MAX_DEPTH} deep")));
                }
                open.push(element(&start).map_err(at)?);
            }
            Event::Empty(start) => {
                n_elements += 1;
                let element = element(&start).map_err(at)?;
                open.last_mut()
                    .expect("the list of open elements has a first")
                    .children
                    .push(element);
            }
            Event::End(_) => {
                let closed = open.pop().expect("the parser matches ends with starts");
                let parent = open
                    .last_mut()
                    .ok_or_else(|| at("an end without a start".into()))?;
                parent.children.push(closed);
            }
            Event::Text(text) => {
                let inside = open
                    .last_mut()
                    .expect("the list of open elements has a first");
                inside.text.push_str(text.trim());
            }
            Event::Eof if open.len() > 1 => {
                return Err(at("the end of the file inside an element".into()));
            }
            Event::Eof => break,
            _ => {}
        }
        if n_elements > MAX_ELEMENTS {
            return Err(at(format!("more than {MAX_ELEMENTS} elements")));
        }
    }
    let root = open.pop().and_then(|mut top| top.children.pop());
    root.ok_or_else(|| ("no element".into(), 0))
}

fn element(start: &BytesStart<'_>) -> Result<Element, String> {
    let mut attributes = Vec::new();
    for attribute in start.attributes() {
        let attribute = attribute.map_err(|error| error.to_string())?;
        let value = attribute.normalized_value(quick_xml::XmlVersion::Implicit1_0);
        let value = value.map_err(|error| error.to_string())?;
        attributes.push((attribute.key.as_ref().into(), value.into()));
    }
    Ok(Element {
        name: start.name().as_ref().into(),
        attributes,
        ..Element::default()
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_tree_of_elements() {
        let text =
            r#"<?xml version="1.0"?><a id="7"><!-- c --><b><x> 1.5 </x></b><b n="x &lt; y"/></a>"#;
        let root = parse(text.as_bytes()).unwrap();
        assert_eq!((&*root.name, root.id("id")), ("a", Some(7)));
        assert_eq!(root.number(&["b", "x"]), 1.5);
        assert!(root.number(&["b", "y"]).is_nan());
        let b: Vec<_> = root.all("b").collect();
        assert_eq!(b[1].attribute("n"), Some("x < y"));
    }

    #[test]
    fn damage_is_told_with_its_place() {
        let check = |text: &str, expected: &str| {
            let (found, _) = parse(text.as_bytes()).unwrap_err();
            assert!(found.contains(expected), "{found}");
        };
        check("", "no element");
        check("<a><b></a>", "b");
        check("<a><b>", "inside an element");
        check("</a>", "a");
        check(&"<a>".repeat(1000), "nested");
        assert_eq!(parse(b"<a>\xff</a>").unwrap_err().1, 3);
    }
}
