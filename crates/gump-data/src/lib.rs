//! Dataset formats in and out, with Scenario in between.
