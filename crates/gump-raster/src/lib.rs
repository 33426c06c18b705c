//! A scene as a bird's-eye image.
