//! A scene as tokens and back, with its grammar.
