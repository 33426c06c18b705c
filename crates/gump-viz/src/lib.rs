//! Pictures, films and pages.
