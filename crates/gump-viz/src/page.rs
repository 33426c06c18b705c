//! Pages: one HTML file with everything in it, pictures and films included.

use std::fmt::Write;
use std::path::Path;

use base64::Engine;
use base64::engine::general_purpose::STANDARD as BASE64;

use crate::files::write_whole;
use crate::{Chart, Film, Picture, VizError};

/// A report under construction; sections appear in the order in which they are begun.
#[derive(Clone, Debug)]
pub struct Page {
    title: String,
    lede: String,
    footer: String,
    sections: Vec<Section>,
}

/// Part of a page under one heading. All text is escaped.
#[derive(Clone, Debug)]
pub struct Section {
    heading: String,
    body: String,
}

impl Page {
    /// An empty page.
    pub fn new(title: impl Into<String>) -> Self {
        Self {
            title: title.into(),
            lede: String::new(),
            footer: String::new(),
            sections: Vec::new(),
        }
    }

    /// Sets the sentence under the title.
    pub fn lede(&mut self, text: impl Into<String>) -> &mut Self {
        self.lede = text.into();
        self
    }

    /// Sets the line at the end: how the page was made.
    pub fn footer(&mut self, text: impl Into<String>) -> &mut Self {
        self.footer = text.into();
        self
    }

    /// Begins a section and lends it to be filled.
    pub fn section(&mut self, heading: impl Into<String>) -> &mut Section {
        self.sections.push(Section {
            heading: heading.into(),
            body: String::new(),
        });
        self.sections
            .last_mut()
            .expect("a section was just appended")
    }

    /// The whole page; it refers to nothing outside itself.
    pub fn to_html(&self) -> String {
        let mut html = format!(
            "<!doctype html>\n<html lang=\"en\">\n<head>\n<meta charset=\"utf-8\">\n\
             <meta name=\"viewport\" content=\"width=device-width, initial-scale=1\">\n\
             <title>{title}</title>\n<style>\n{css}</style>\n</head>\n<body>\n<header>\n\
             <h1>{title}</h1>\n",
            title = escape(&self.title),
            css = concat!(include_str!("palette.css"), include_str!("page.css")),
        );
        if !self.lede.is_empty() {
            push(
                &mut html,
                format_args!("<p class=\"lede\">{}</p>\n", escape(&self.lede)),
            );
        }
        if self.sections.len() > 2 {
            html.push_str(&self.contents());
        }
        html.push_str("</header>\n<main>\n");
        for (i, section) in self.sections.iter().enumerate() {
            let (heading, body) = (escape(&section.heading), &section.body);
            let number = i + 1;
            push(
                &mut html,
                format_args!("<section id=\"s{number}\">\n<h2>{heading}</h2>\n{body}</section>\n"),
            );
        }
        html.push_str("</main>\n");
        if !self.footer.is_empty() {
            push(
                &mut html,
                format_args!("<footer>{}</footer>\n", escape(&self.footer)),
            );
        }
        html.push_str("</body>\n</html>\n");
        html
    }

    /// Writes the page; a reader finds the old file or the new one, never half of one.
    ///
    /// # Errors
    /// [`VizError::Write`] with the path.
    pub fn save(&self, path: &Path) -> Result<(), VizError> {
        write_whole(path, self.to_html().as_bytes())
    }

    fn contents(&self) -> String {
        let links = self.sections.iter().enumerate().map(|(i, section)| {
            let heading = escape(&section.heading);
            format!("<a href=\"#s{}\">{heading}</a>\n", i + 1)
        });
        format!("<nav>\n{}</nav>\n", links.collect::<String>())
    }
}

impl Section {
    /// A paragraph.
    pub fn prose(&mut self, text: &str) -> &mut Self {
        self.add(format_args!("<p>{}</p>\n", escape(text)))
    }

    /// A paragraph that is a link to a file beside the page, such as `viewer.html`.
    pub fn link(&mut self, file: &str, text: &str) -> &mut Self {
        let (file, text) = (escape(file), escape(text));
        self.add(format_args!("<p><a href=\"{file}\">{text}</a></p>\n"))
    }

    /// A command or other text in which spaces matter.
    pub fn preformatted(&mut self, text: &str) -> &mut Self {
        self.add(format_args!("<pre>{}</pre>\n", escape(text)))
    }

    /// Headline numbers, as (value with unit, what it is).
    pub fn stats(&mut self, stats: &[(String, String)]) -> &mut Self {
        self.definitions("stats", stats.iter().map(|(value, name)| (name, value)))
    }

    /// Facts, as (name, value).
    pub fn key_values(&mut self, facts: &[(String, String)]) -> &mut Self {
        self.definitions("facts", facts.iter().map(|(name, value)| (name, value)))
    }

    /// A table; columns in which every cell is a number are set flush right.
    pub fn table(&mut self, headers: &[&str], rows: &[Vec<String>]) -> &mut Self {
        let is_number = |column: usize| {
            let mut cells = rows.iter().filter_map(|row| row.get(column));
            !rows.is_empty() && cells.all(|cell| looks_numeric(cell))
        };
        let class: Vec<&str> = (0..headers.len())
            .map(|column| {
                if is_number(column) {
                    " class=\"number\""
                } else {
                    ""
                }
            })
            .collect();
        let mut html = String::from("<div class=\"scroll\"><table>\n<thead><tr>");
        for (header, class) in headers.iter().zip(&class) {
            push(
                &mut html,
                format_args!("<th{class}>{}</th>", escape(header)),
            );
        }
        html.push_str("</tr></thead>\n<tbody>\n");
        for row in rows {
            html.push_str("<tr>");
            for (cell, class) in row.iter().zip(&class) {
                push(&mut html, format_args!("<td{class}>{}</td>", escape(cell)));
            }
            html.push_str("</tr>\n");
        }
        html.push_str("</tbody>\n</table></div>\n");
        self.add(format_args!("{html}"))
    }

    /// A still picture with a caption, which is also its text for those who cannot see it.
    ///
    /// # Errors
    /// As [`Picture::to_png`].
    pub fn picture(&mut self, picture: &Picture, caption: &str) -> Result<&mut Self, VizError> {
        let image = image(&png_uri(picture)?, picture.width, picture.height, caption);
        Ok(self.add(format_args!("{}", figure(&image, caption))))
    }

    /// One picture in two themes; the reader's setting decides which is shown.
    ///
    /// # Errors
    /// As [`Picture::to_png`].
    pub fn themed_picture(
        &mut self,
        light: &Picture,
        dark: &Picture,
        caption: &str,
    ) -> Result<&mut Self, VizError> {
        let image = image(&png_uri(light)?, light.width, light.height, caption);
        let themed = format!(
            "<picture><source media=\"(prefers-color-scheme: dark)\" srcset=\"{}\">{image}</picture>",
            png_uri(dark)?
        );
        Ok(self.add(format_args!("{}", figure(&themed, caption))))
    }

    /// Several pictures side by side, as many in a row as there is room for.
    ///
    /// # Errors
    /// As [`Picture::to_png`].
    pub fn gallery(&mut self, pictures: &[(Picture, String)]) -> Result<&mut Self, VizError> {
        let mut html = String::from("<div class=\"gallery\">\n");
        for (picture, caption) in pictures {
            let image = image(&png_uri(picture)?, picture.width, picture.height, caption);
            html.push_str(&figure(&image, caption));
        }
        Ok(self.add(format_args!("{html}</div>\n")))
    }

    /// A film with a caption.
    pub fn film(&mut self, film: &Film, caption: &str) -> &mut Self {
        let uri = format!("data:image/gif;base64,{}", BASE64.encode(&film.gif));
        let image = image(&uri, film.width, film.height, caption);
        self.add(format_args!("{}", figure(&image, caption)))
    }

    /// A chart with a caption; its text takes the colour of the page.
    ///
    /// # Errors
    /// As [`Chart::to_svg`].
    pub fn chart(&mut self, chart: &Chart, caption: &str) -> Result<&mut Self, VizError> {
        // Inside HTML the namespace is known, and nothing here looks like an address.
        let svg = chart.to_svg()?;
        let svg = svg.replacen(" xmlns=\"http://www.w3.org/2000/svg\"", "", 1);
        Ok(self.add(format_args!("{}", figure(&svg, caption))))
    }

    fn definitions<'t>(
        &mut self,
        class: &str,
        entries: impl Iterator<Item = (&'t String, &'t String)>,
    ) -> &mut Self {
        let entries = entries.map(|(name, value)| {
            let (name, value) = (escape(name), escape(value));
            if class == "stats" {
                format!("<div><dt>{name}</dt><dd>{value}</dd></div>\n")
            } else {
                format!("<dt>{name}</dt><dd>{value}</dd>\n")
            }
        });
        let entries: String = entries.collect();
        self.add(format_args!("<dl class=\"{class}\">\n{entries}</dl>\n"))
    }

    fn add(&mut self, html: std::fmt::Arguments<'_>) -> &mut Self {
        push(&mut self.body, html);
        self
    }
}

fn push(html: &mut String, text: std::fmt::Arguments<'_>) {
    html.write_fmt(text)
        .expect("writing to a string cannot fail");
}

fn png_uri(picture: &Picture) -> Result<String, VizError> {
    Ok(format!(
        "data:image/png;base64,{}",
        BASE64.encode(picture.to_png()?)
    ))
}

fn image(uri: &str, width: usize, height: usize, text: &str) -> String {
    let text = escape(text);
    format!("<img src=\"{uri}\" width=\"{width}\" height=\"{height}\" alt=\"{text}\">")
}

fn figure(content: &str, caption: &str) -> String {
    if caption.is_empty() {
        return format!("<figure>{content}</figure>\n");
    }
    let caption = escape(caption);
    format!("<figure>{content}<figcaption>{caption}</figcaption></figure>\n")
}

/// True for numbers with an optional sign, unit or spread, and for the dash of a missing one.
fn looks_numeric(cell: &str) -> bool {
    let cell = cell.trim();
    let unsigned = cell.trim_start_matches(['+', '-', '\u{2212}', '\u{B1}', '<', '>', ' ']);
    unsigned.starts_with(|c: char| c.is_ascii_digit())
        || matches!(cell, "" | "-" | "\u{2013}" | "\u{2014}" | "n/a")
}

/// Replaces what has a meaning in HTML text and attributes.
pub(crate) fn escape(text: &str) -> String {
    let mut escaped = String::with_capacity(text.len());
    for character in text.chars() {
        match character {
            '&' => escaped.push_str("&amp;"),
            '<' => escaped.push_str("&lt;"),
            '>' => escaped.push_str("&gt;"),
            '"' => escaped.push_str("&quot;"),
            '\'' => escaped.push_str("&#39;"),
            other => escaped.push(other),
        }
    }
    escaped
}
