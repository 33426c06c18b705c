//! The Python package `gump`, as far as it is Rust: the module `gump._native`.
//!
//! Arrays come in as contiguous NumPy arrays of one type each, which `python/gump` sees to, and are
//! checked here; work is done without the interpreter's lock, on the threads of `threads`; arrays
//! and plain values go out. Nothing here computes: each file calls one or two crates.
//!
//! Start with `scenario`, then `wosac`. What users read is in `python/gump`.

#![allow(
    clippy::needless_pass_by_value,
    reason = "PyO3 hands arguments over by value, and map_err errors"
)]

mod arrays;
mod env;
mod errors;
mod generate;
mod messages;
mod motion;
mod nuplan;
mod reader;
mod scenario;
mod scenario_arrays;
mod threads;
mod world;
mod wosac;

use pyo3::prelude::*;

/// The native module of the package.
#[pymodule(name = "_native")]
mod native {
    use super::{Bound, PyModule, PyModuleMethods as _, PyResult};

    #[pymodule_export]
    use super::env::Env;
    #[pymodule_export]
    use super::errors::DataError;
    #[pymodule_export]
    use super::generate::generate;
    #[pymodule_export]
    use super::messages::{rollouts_from_file, rollouts_from_message, rollouts_to_message};
    #[pymodule_export]
    use super::motion::Tally;
    #[pymodule_export]
    use super::nuplan::{nuplan_plan, nuplan_score, nuplan_simulate};
    #[pymodule_export]
    use super::reader::{Reader, find, read};
    #[pymodule_export]
    use super::scenario::Scenario;
    #[pymodule_export]
    use super::threads::{n_threads, set_threads};
    #[pymodule_export]
    use super::world::{Session, World};
    #[pymodule_export]
    use super::wosac::{
        wosac_score, wosac_score_catk, wosac_score_many, wosac_score_message, wosac_weights,
    };

    #[pymodule_init]
    fn init(module: &Bound<'_, PyModule>) -> PyResult<()> {
        module.add("__version__", env!("CARGO_PKG_VERSION"))
    }
}
