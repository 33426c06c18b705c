//! Errors of the crates as Python's exceptions, a sentence each.

use std::fmt::Display;
use std::io;

use pyo3::PyErr;
use pyo3::exceptions::{PyFileNotFoundError, PyOSError, PyRuntimeError, PyValueError};

pyo3::create_exception!(
    gump,
    DataError,
    PyValueError,
    "A file or message that is not what it should be; the sentence names the place."
);

/// An error of a reader: a missing file, an error of the operating system, or damaged data.
pub(crate) fn data(error: &gump_data::DataError) -> PyErr {
    match error {
        gump_data::DataError::Missing { .. } => PyFileNotFoundError::new_err(error.to_string()),
        gump_data::DataError::Io { source, .. } if source.kind() == io::ErrorKind::NotFound => {
            PyFileNotFoundError::new_err(error.to_string())
        }
        gump_data::DataError::Io { .. } => PyOSError::new_err(error.to_string()),
        _ => DataError::new_err(error.to_string()),
    }
}

/// An invalid argument.
pub(crate) fn value(error: impl Display) -> PyErr {
    PyValueError::new_err(error.to_string())
}

/// Work that failed with valid arguments.
pub(crate) fn runtime(error: impl Display) -> PyErr {
    PyRuntimeError::new_err(error.to_string())
}

/// A malformed message.
pub(crate) fn data_problem(problem: gump_data::Problem) -> PyErr {
    DataError::new_err(problem.to_string())
}
