//! Errors of compressing and writing.

use std::io;
use std::path::PathBuf;

/// Why something could not be drawn to a file.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum VizError {
    /// The file system refused.
    #[error("could not write {path}", path = path.display())]
    Write {
        /// The reason.
        source: io::Error,
        /// The file.
        path: PathBuf,
    },
    /// A picture does not fit its format.
    #[error("could not encode a PNG")]
    Png(#[from] image::ImageError),
    /// A film does not fit its format.
    #[error("could not encode a GIF")]
    Gif(#[from] gif::EncodingError),
    /// A film does not fit the format of animated PNGs.
    #[error("could not encode an animated PNG")]
    Apng(#[from] png::EncodingError),
    /// Videos are encoded by another program.
    #[error(
        "expected ffmpeg on the path to encode an MP4, found none; GIFs and animated PNGs need nothing"
    )]
    NoFfmpeg,
    /// The video's encoder refused.
    #[error("ffmpeg could not encode the MP4: {0}")]
    Ffmpeg(String),
    /// A side of a picture or film is zero or beyond what its format can hold.
    #[error("{width} x {height} px is not a size of a picture or film")]
    Size {
        /// Columns.
        width: usize,
        /// Rows.
        height: usize,
    },
    /// A film of no futures has no frames.
    #[error("a film needs at least one rollout")]
    NothingToFilm,
    /// No series has a finite point (for logarithmic axes: a positive one).
    #[error("chart \"{title}\" has no point to draw")]
    EmptyChart {
        /// Title of the chart.
        title: String,
    },
    /// The chart backend refused.
    #[error("could not draw chart \"{title}\": {reason}")]
    Chart {
        /// Title of the chart.
        title: String,
        /// The backend's message.
        reason: String,
    },
    /// Rerun's library refused.
    #[cfg(feature = "rerun")]
    #[error("could not encode a recording for Rerun")]
    Rerun(#[source] Box<dyn std::error::Error + Send + Sync>),
}
