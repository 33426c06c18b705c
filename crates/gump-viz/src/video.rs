//! Videos, encoded by the program `ffmpeg`.
//!
//! A built-in encoder or one in C would be a large dependency for a format that few users need, and
//! those mostly have `ffmpeg`.

use std::io::{self, Read as _, Write as _};
use std::path::Path;
use std::process::{Command, Stdio};

use crate::VizError;

/// Whether films can be written as MP4 here: whether `ffmpeg` runs.
pub fn can_encode_mp4() -> bool {
    let version = Command::new("ffmpeg")
        .arg("-version")
        .stdin(Stdio::null())
        .stdout(Stdio::null())
        .stderr(Stdio::null())
        .status();
    version.is_ok_and(|status| status.success())
}

/// Writes a video of frames of `width` by `height` pixels, each red, green and blue row by row and
/// `delay` hundredths of a second long.
///
/// # Errors
/// [`VizError::NoFfmpeg`] if there is none, [`VizError::Ffmpeg`] with its message.
pub(crate) fn encode(
    path: &Path,
    (width, height): (usize, usize),
    delay: u16,
    frames: impl Iterator<Item = Vec<u8>>,
) -> Result<(), VizError> {
    let refused = |error: io::Error| VizError::Ffmpeg(error.to_string());
    // Players everywhere support even numbers of rows and columns with colour at half resolution.
    let filter = "pad=ceil(iw/2)*2:ceil(ih/2)*2,format=yuv420p";
    let mut child = Command::new("ffmpeg")
        .args(["-v", "error", "-y", "-f", "rawvideo", "-pix_fmt", "rgb24"])
        .args(["-s", &format!("{width}x{height}")])
        .args(["-r", &format!("100/{delay}"), "-i", "-", "-vf", filter])
        .args(["-movflags", "+faststart", "-f", "mp4"])
        .arg(path)
        .stdin(Stdio::piped())
        .stdout(Stdio::null())
        .stderr(Stdio::piped())
        .spawn()
        .map_err(|error| match error.kind() {
            io::ErrorKind::NotFound => VizError::NoFfmpeg,
            _ => refused(error),
        })?;
    let mut written = Ok(());
    if let Some(mut input) = child.stdin.take() {
        for frame in frames {
            written = input.write_all(&frame);
            if written.is_err() {
                break;
            }
        }
    }
    let mut messages = String::new();
    if let Some(mut errors) = child.stderr.take() {
        errors.read_to_string(&mut messages).map_err(refused)?;
    }
    let status = child.wait().map_err(refused)?;
    if !status.success() {
        let reason = messages.lines().next_back().unwrap_or("it gave no reason");
        return Err(VizError::Ffmpeg(reason.to_owned()));
    }
    written.map_err(refused)
}
