//! Columns of a Parquet or Feather table, by name, as plain vectors.

use std::fs::File;
use std::io::{Cursor, Read};
use std::path::Path;

use arrow_array::cast::AsArray;
use arrow_array::types::{Float32Type, Float64Type, Int32Type, Int64Type, UInt64Type};
use arrow_array::{Array, RecordBatch};
use arrow_ipc::reader::FileReader;
use arrow_schema::DataType;
use parquet::arrow::arrow_reader::ParquetRecordBatchReaderBuilder;

use super::stream::io_error;
use crate::DataError;

/// The most rows of one table: a scenario has tens of thousands.
const MAX_ROWS: usize = 5_000_000;
/// The largest file, bytes. Damaged files may unpack to anything; smaller ones to less.
const MAX_BYTES: u64 = 256 << 20;

/// A whole table.
pub(crate) struct Table {
    batches: Vec<RecordBatch>,
    pub(crate) n_rows: usize,
}

/// Reads a Parquet file.
pub(crate) fn parquet(path: &Path) -> Result<Table, DataError> {
    guarded(path, read_parquet)
}

/// Reads a Feather file (version 2, which is Arrow IPC).
pub(crate) fn feather(path: &Path) -> Result<Table, DataError> {
    guarded(path, read_feather)
}

/// The table crates panic on some damaged files; here that is an error like any other.
fn guarded(path: &Path, read: fn(&Path) -> Result<Table, DataError>) -> Result<Table, DataError> {
    std::panic::catch_unwind(|| read(path))
        .unwrap_or_else(|_| Err(damaged(&"damage that its reader cannot cope with", path)))
}

fn read_parquet(path: &Path) -> Result<Table, DataError> {
    let file = open(path)?;
    let builder = ParquetRecordBatchReaderBuilder::try_new(file).map_err(|e| damaged(&e, path))?;
    let stated = builder.metadata().file_metadata().num_rows();
    if !usize::try_from(stated).is_ok_and(|rows| rows <= MAX_ROWS) {
        return Err(too_long(stated, path));
    }
    let reader = builder.build().map_err(|e| damaged(&e, path))?;
    collect(reader, path)
}

fn read_feather(path: &Path) -> Result<Table, DataError> {
    let mut bytes = Vec::new();
    let read = open(path)?.take(MAX_BYTES).read_to_end(&mut bytes);
    read.map_err(|e| io_error("read", e, path))?;
    let unpacked = unpacked_bytes(&bytes).ok_or_else(|| damaged(&"no sound footer", path))?;
    if unpacked > MAX_BYTES {
        let found = format!("columns of {unpacked} bytes, more than {MAX_BYTES}");
        return Err(damaged(&found, path));
    }
    let reader = FileReader::try_new(Cursor::new(bytes), None).map_err(|e| damaged(&e, path))?;
    collect(reader, path)
}

/// Total unpacked size that the columns of a Feather file claim, bytes; `None` if it has no valid
/// footer, or one that refers to bytes beyond the file.
///
/// The crate that unpacks them allocates the claimed size of a block or column before it checks it.
///
/// Source: "Arrow columnar format", IPC file format and body compression: the footer lists blocks
/// of a message and a body; a packed buffer of the body begins with its length, -1 if it is not.
fn unpacked_bytes(bytes: &[u8]) -> Option<u64> {
    const TAIL: usize = 10;
    let tail = bytes.len().checked_sub(TAIL)?;
    let length = i32::from_le_bytes(*bytes.get(tail..)?.first_chunk()?);
    let footer = bytes.get(tail.checked_sub(usize::try_from(length).ok()?)?..tail)?;
    let footer = arrow_ipc::root_as_footer(footer).ok()?;
    let batches = footer.recordBatches().into_iter().flatten();
    let blocks = batches.chain(footer.dictionaries().into_iter().flatten());
    let mut total = 0_u64;
    for block in blocks {
        let start = usize::try_from(block.offset()).ok()?;
        let body = start.checked_add(usize::try_from(block.metaDataLength()).ok()?)?;
        let message = bytes.get(start..body)?;
        let end = body.checked_add(usize::try_from(block.bodyLength()).ok()?)?;
        bytes.get(body..end)?;
        // Since version 0.15 a marker of four bytes precedes the length.
        let prefix = if message.starts_with(&[0xff; 4]) {
            8
        } else {
            4
        };
        let message = arrow_ipc::root_as_message(message.get(prefix..)?).ok()?;
        let dictionary = message.header_as_dictionary_batch().and_then(|d| d.data());
        let Some(batch) = message.header_as_record_batch().or(dictionary) else {
            continue;
        };
        if batch.compression().is_none() {
            continue;
        }
        for buffer in batch
            .buffers()
            .into_iter()
            .flatten()
            .filter(|b| b.length() > 0)
        {
            let at = body.checked_add(usize::try_from(buffer.offset()).ok()?)?;
            let claimed = i64::from_le_bytes(*bytes.get(at..)?.first_chunk()?);
            total = total.saturating_add(u64::try_from(claimed).unwrap_or(0));
        }
    }
    Some(total)
}

fn open(path: &Path) -> Result<File, DataError> {
    let file = File::open(path).map_err(|e| io_error("open", e, path))?;
    let length = file
        .metadata()
        .map_err(|e| io_error("read", e, path))?
        .len();
    if length > MAX_BYTES {
        return Err(DataError::TooLarge {
            what: "a table",
            limit: MAX_BYTES,
            path: path.into(),
        });
    }
    Ok(file)
}

fn collect<E: std::fmt::Display>(
    reader: impl Iterator<Item = Result<RecordBatch, E>>,
    path: &Path,
) -> Result<Table, DataError> {
    let (mut batches, mut n_rows) = (Vec::new(), 0);
    for batch in reader {
        let batch = batch.map_err(|e| damaged(&e, path))?;
        n_rows += batch.num_rows();
        if n_rows > MAX_ROWS {
            return Err(too_long(n_rows as i64, path));
        }
        batches.push(batch);
    }
    Ok(Table { batches, n_rows })
}

fn damaged(error: &dyn std::fmt::Display, path: &Path) -> DataError {
    DataError::Table {
        expected: "a table".into(),
        found: error.to_string(),
        path: path.into(),
    }
}

fn too_long(rows: i64, path: &Path) -> DataError {
    DataError::Table {
        expected: format!("at most {MAX_ROWS} rows"),
        found: rows.to_string(),
        path: path.into(),
    }
}

impl Table {
    /// A column of numbers; NaN where a value is missing.
    pub(crate) fn numbers(&self, name: &str, path: &Path) -> Result<Vec<f64>, DataError> {
        self.column(name, "numbers", path, |column, values| {
            macro_rules! extend {
                ($($variant:ident => $kind:ty),*) => {
                    match column.data_type() {
                        $(DataType::$variant => {
                            let column = column.as_primitive::<$kind>();
                            values.extend(column.iter().map(|v| v.map_or(f64::NAN, |v| v as f64)));
                            true
                        })*
                        _ => false,
                    }
                };
            }
            extend!(
                Float64 => Float64Type, Float32 => Float32Type, Int64 => Int64Type,
                Int32 => Int32Type, UInt64 => UInt64Type
            )
        })
    }

    /// A column of whole numbers; -1 where a value is missing.
    pub(crate) fn integers(&self, name: &str, path: &Path) -> Result<Vec<i64>, DataError> {
        self.column(name, "whole numbers", path, |column, values| {
            match column.data_type() {
                DataType::Int64 => {
                    let column = column.as_primitive::<Int64Type>();
                    values.extend(column.iter().map(|v| v.unwrap_or(-1)));
                }
                DataType::Int32 => {
                    let column = column.as_primitive::<Int32Type>();
                    values.extend(column.iter().map(|v| v.map_or(-1, i64::from)));
                }
                DataType::UInt64 => {
                    let column = column.as_primitive::<UInt64Type>();
                    values.extend(
                        column
                            .iter()
                            .map(|v| v.and_then(|v| v.try_into().ok()).unwrap_or(-1)),
                    );
                }
                _ => return false,
            }
            true
        })
    }

    /// A column of yes and no; no where a value is missing.
    pub(crate) fn flags(&self, name: &str, path: &Path) -> Result<Vec<bool>, DataError> {
        self.column(name, "truth values", path, |column, values| {
            let flags = column.as_boolean_opt();
            values.extend(flags.into_iter().flatten().map(|v| v == Some(true)));
            flags.is_some()
        })
    }

    /// A column of text; empty where a value is missing.
    pub(crate) fn texts(&self, name: &str, path: &Path) -> Result<Vec<String>, DataError> {
        self.column(name, "text", path, |column, values: &mut Vec<String>| {
            let owned = |text: Option<&str>| text.unwrap_or_default().to_owned();
            match column.data_type() {
                DataType::Utf8 => values.extend(column.as_string::<i32>().iter().map(owned)),
                DataType::LargeUtf8 => values.extend(column.as_string::<i64>().iter().map(owned)),
                DataType::Utf8View => values.extend(column.as_string_view().iter().map(owned)),
                DataType::Dictionary(..) => {
                    let Some(dictionary) = column.as_any_dictionary_opt() else {
                        return false;
                    };
                    let Some(words) = dictionary.values().as_string_opt::<i32>() else {
                        return false;
                    };
                    let keys = dictionary.normalized_keys();
                    values.extend(keys.into_iter().enumerate().map(|(row, key)| {
                        let there = column.is_valid(row) && key < words.len();
                        owned(there.then(|| words.value(key)))
                    }));
                }
                _ => return false,
            }
            true
        })
    }

    fn column<T>(
        &self,
        name: &str,
        what: &str,
        path: &Path,
        extend: impl Fn(&dyn Array, &mut Vec<T>) -> bool,
    ) -> Result<Vec<T>, DataError> {
        let mut values = Vec::with_capacity(self.n_rows);
        let missing = |found: String| DataError::Table {
            expected: format!("a column {name} of {what}"),
            found,
            path: path.into(),
        };
        for batch in &self.batches {
            let column = batch
                .column_by_name(name)
                .ok_or_else(|| missing("none".into()))?;
            if !extend(column.as_ref(), &mut values) {
                return Err(missing(format!("{}", column.data_type())));
            }
        }
        Ok(values)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_block_beyond_the_file_is_refused_before_memory_is_taken_for_it() {
        let sound = include_bytes!("../../tests/hostile/argoverse2_log/seed.feather");
        assert!(unpacked_bytes(sound).is_some_and(|bytes| bytes < 1 << 20));
        // Found by the fuzzer: two gigabytes for a file of four kilobytes.
        let damaged =
            include_bytes!("../../tests/hostile/argoverse2_log/block_beyond_the_file.feather");
        assert_eq!(unpacked_bytes(damaged), None);
    }
}
