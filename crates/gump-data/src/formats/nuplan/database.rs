//! Read-only access to an SQLite file.
//!
//! `log` and `geopackage` define the meaning of its tables.

use std::fs::File;
use std::io::Read;
use std::path::{Path, PathBuf};

use rusqlite::types::ValueRef;
use rusqlite::{Connection, OpenFlags, Params, Row};

use super::Token;
use crate::DataError;
use crate::io::stream::io_error;

/// The first bytes of every SQLite file.
pub(super) const MAGIC: &[u8; 16] = b"SQLite format 3\0";

/// An open database and its place, for errors.
pub(super) struct Database {
    connection: Connection,
    path: PathBuf,
}

impl Database {
    /// Opens a file for reading.
    ///
    /// Error: [`DataError::Missing`], [`DataError::Io`], [`DataError::Table`] for a file that is no
    /// database, [`DataError::Sqlite`].
    pub(super) fn open(path: &Path) -> Result<Self, DataError> {
        if !path.exists() {
            return Err(DataError::Missing { path: path.into() });
        }
        check_magic(path)?;
        let failed = |source| DataError::Sqlite {
            doing: "open the database",
            source,
            path: path.into(),
        };
        let flags = OpenFlags::SQLITE_OPEN_READ_ONLY | OpenFlags::SQLITE_OPEN_NO_MUTEX;
        let connection = Connection::open_with_flags(path, flags).map_err(failed)?;
        // A damaged schema must not run anything, nor may damaged pages be trusted.
        connection
            .execute_batch("PRAGMA trusted_schema = OFF; PRAGMA cell_size_check = ON;")
            .map_err(failed)?;
        Ok(Self {
            connection,
            path: path.into(),
        })
    }

    pub(super) fn path(&self) -> &Path {
        &self.path
    }

    /// The rows of a query.
    ///
    /// Error: [`DataError::Sqlite`], also for a value of another type than `read` asks for.
    pub(super) fn rows<T>(
        &self,
        doing: &'static str,
        sql: &str,
        params: impl Params,
        read: impl FnMut(&Row<'_>) -> rusqlite::Result<T>,
    ) -> Result<Vec<T>, DataError> {
        let collect = || {
            let mut statement = self.connection.prepare_cached(sql)?;
            statement.query_map(params, read)?.collect()
        };
        let result: rusqlite::Result<Vec<T>> = collect();
        result.map_err(|source| DataError::Sqlite {
            doing,
            source,
            path: self.path.clone(),
        })
    }

    /// The names of all tables.
    pub(super) fn tables(&self) -> Result<Vec<String>, DataError> {
        let sql = "SELECT name FROM sqlite_master WHERE type IN ('table', 'view') ORDER BY name";
        self.rows("list the tables", sql, [], |row| row.get(0))
    }

    /// The names of a table's columns; none if there is no such table.
    pub(super) fn columns(&self, table: &str) -> Result<Vec<String>, DataError> {
        let sql = "SELECT name FROM pragma_table_info(?1)";
        self.rows("list the columns", sql, [table], |row| row.get(0))
    }

    /// Checks that a table has these columns.
    ///
    /// Error: [`DataError::Table`], which names the first that is missing and what there is.
    pub(super) fn require(&self, table: &str, columns: &[&str]) -> Result<(), DataError> {
        let found = self.columns(table)?;
        let (expected, found) = if found.is_empty() {
            (format!("a table {table}"), list(&self.tables()?))
        } else {
            let missing = columns.iter().find(|c| !found.iter().any(|f| f == *c));
            let Some(column) = missing else {
                return Ok(());
            };
            (format!("a column {column} in table {table}"), list(&found))
        };
        Err(DataError::Table {
            expected,
            found,
            path: self.path.clone(),
        })
    }
}

/// The token in a column; an error of the query if it is none.
pub(super) fn token(row: &Row<'_>, column: usize) -> rusqlite::Result<Token> {
    let bytes = match row.get_ref(column)? {
        ValueRef::Blob(bytes) => Token::from_bytes(bytes),
        _ => None,
    };
    bytes.ok_or_else(|| {
        let kind = row.get_ref(column).map(|value| value.data_type());
        rusqlite::Error::FromSqlConversionFailure(
            column,
            kind.unwrap_or(rusqlite::types::Type::Null),
            "expected a token of 8 bytes".into(),
        )
    })
}

/// The number in a column, NaN where there is none: SQLite stores NaN as NULL.
pub(super) fn real(row: &Row<'_>, column: usize) -> rusqlite::Result<f64> {
    Ok(row.get::<_, Option<f64>>(column)?.unwrap_or(f64::NAN))
}

fn check_magic(path: &Path) -> Result<(), DataError> {
    let mut head = Vec::new();
    let file = File::open(path).map_err(|e| io_error("open", e, path))?;
    file.take(MAGIC.len() as u64)
        .read_to_end(&mut head)
        .map_err(|e| io_error("read", e, path))?;
    if head == MAGIC {
        return Ok(());
    }
    let found = if head.starts_with(&[0x1f, 0x8b]) {
        "a gzip file; SQLite cannot read packed files, so unpack it first".into()
    } else {
        format!("a file that starts with {}", head.escape_ascii())
    };
    Err(DataError::Table {
        expected: "a SQLite database".into(),
        found,
        path: path.into(),
    })
}

fn list(names: &[String]) -> String {
    if names.is_empty() {
        return "none".into();
    }
    names.join(", ")
}
