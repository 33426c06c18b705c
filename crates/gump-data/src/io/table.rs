//! Tables as Parquet files, for pandas, polars and similar libraries.
//!
//! Start with [`Table`]: named columns of text, integers, numbers or booleans of equal length.
//! `tracks` and `rollouts` define their tables.

use std::io::{self, Write};
use std::path::Path;
use std::sync::Arc;

use arrow_array::{
    Array as _, ArrayRef, BooleanArray, Float64Array, Int64Array, RecordBatch, StringArray,
};
use arrow_schema::{DataType, Field, Schema, SchemaRef};
use parquet::arrow::ArrowWriter;
use parquet::basic::{Compression, ZstdLevel};
use parquet::file::properties::WriterProperties;

use super::stream::io_error;
use crate::{DataError, write_atomically};

/// Named columns of equal length, to be written as Parquet; every value may be missing.
///
/// ```
/// use gump_data::Table;
///
/// let folder = tempfile::tempdir()?;
/// Table::default()
///     .text("planner", ["idm", "log"].map(Some))
///     .number("score", [Some(0.75), None])
///     .write(&folder.path().join("scores.parquet"))?;
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
#[derive(Clone, Debug, Default)]
pub struct Table {
    fields: Vec<Field>,
    columns: Vec<ArrayRef>,
}

impl Table {
    /// Adds a column of text.
    ///
    /// # Panics
    /// As the others, if it is not as long as the columns before it.
    pub fn text<S: AsRef<str>>(
        self,
        name: &str,
        values: impl IntoIterator<Item = Option<S>>,
    ) -> Self {
        let values = StringArray::from_iter(values);
        self.column(name, DataType::Utf8, Arc::new(values))
    }

    /// Adds a column of 64-bit integers.
    pub fn integer(self, name: &str, values: impl IntoIterator<Item = Option<i64>>) -> Self {
        let values = Int64Array::from_iter(values);
        self.column(name, DataType::Int64, Arc::new(values))
    }

    /// Adds a column of 64-bit floating-point numbers; NaN values are missing.
    pub fn number(self, name: &str, values: impl IntoIterator<Item = Option<f64>>) -> Self {
        let numbers = values.into_iter().map(|v| v.filter(|v| !v.is_nan()));
        let values = Float64Array::from_iter(numbers);
        self.column(name, DataType::Float64, Arc::new(values))
    }

    /// Adds a column of booleans.
    pub fn truth(self, name: &str, values: impl IntoIterator<Item = Option<bool>>) -> Self {
        let values = BooleanArray::from_iter(values);
        self.column(name, DataType::Boolean, Arc::new(values))
    }

    fn column(mut self, name: &str, kind: DataType, values: ArrayRef) -> Self {
        let is_first = self.columns.is_empty();
        assert!(
            is_first || self.n_rows() == values.len(),
            "the column {name} has {} rows, those before it {}",
            values.len(),
            self.n_rows()
        );
        self.fields.push(Field::new(name, kind, true));
        self.columns.push(values);
        self
    }

    /// Names of the columns in order.
    pub fn names(&self) -> impl Iterator<Item = &str> {
        self.fields.iter().map(|field| field.name().as_str())
    }

    /// Types of the columns, in order: `text`, `integer`, `number` or `truth`.
    pub fn kinds(&self) -> impl Iterator<Item = &'static str> {
        self.fields.iter().map(|field| match field.data_type() {
            DataType::Utf8 => "text",
            DataType::Int64 => "integer",
            DataType::Float64 => "number",
            _ => "truth",
        })
    }

    /// Number of rows.
    pub fn n_rows(&self) -> usize {
        self.columns.first().map_or(0, |column| column.len())
    }

    /// Writes the table; the file appears when it is complete.
    ///
    /// # Errors
    /// [`DataError::Io`].
    pub fn write(self, path: &Path) -> Result<(), DataError> {
        write_tables(path, &self.clone(), [self])
    }
}

/// Writes several tables with the columns of `like` as one, one below the other.
///
/// # Errors
/// [`DataError::Io`].
pub(crate) fn write_tables(
    path: &Path,
    like: &Table,
    tables: impl IntoIterator<Item = Table>,
) -> Result<(), DataError> {
    write_atomically(path, |file| {
        let mut sheet = Sheet::begin(file, like, path)?;
        for table in tables {
            sheet.write(table)?;
        }
        sheet.finish()
    })
}

/// A Parquet file being written, table by table.
pub(crate) struct Sheet<'a, W: Write + Send> {
    writer: ArrowWriter<W>,
    schema: SchemaRef,
    path: &'a Path,
}

impl<'a, W: Write + Send> Sheet<'a, W> {
    /// A file with the columns of `like`; `path` is for errors only.
    pub(crate) fn begin(out: W, like: &Table, path: &'a Path) -> Result<Self, DataError> {
        let schema = Arc::new(Schema::new(like.fields.clone()));
        let properties = WriterProperties::builder()
            .set_compression(Compression::ZSTD(ZstdLevel::default()))
            .build();
        let writer = ArrowWriter::try_new(out, Arc::clone(&schema), Some(properties));
        Ok(Self {
            writer: writer.map_err(|error| failed(error, path))?,
            schema,
            path,
        })
    }

    /// Adds rows.
    pub(crate) fn write(&mut self, rows: Table) -> Result<(), DataError> {
        let batch = RecordBatch::try_new(Arc::clone(&self.schema), rows.columns);
        let batch = batch.map_err(|error| failed(error, self.path))?;
        let written = self.writer.write(&batch);
        written.map_err(|error| failed(error, self.path))
    }

    /// Writes what is left and the footer.
    pub(crate) fn finish(self) -> Result<(), DataError> {
        let closed = self.writer.close();
        closed.map(drop).map_err(|error| failed(error, self.path))
    }
}

fn failed(error: impl std::error::Error + Send + Sync + 'static, path: &Path) -> DataError {
    io_error("write the table", io::Error::other(error), path)
}
