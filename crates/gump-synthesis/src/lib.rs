//! Scenarios made up from nothing: procedural roads and rule-driven traffic.
