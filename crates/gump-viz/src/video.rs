//! Videos, by the program `ffmpeg`.
//!
//! An encoder of our own or one in C would be a large dependency for a format that few need; those
//! who do mostly have `ffmpeg`.

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
/// [`VizError::NoFfmpeg`] if there is none, [`VizError::Ffmpeg`] with what it says.
pub(crate) fn encode(
    path: &Path,
    (width, height): (usize, usize),
    delay: u16,
    frames: impl Iterator<Item = Vec<u8>>,
) -> Result<(), VizError> {
    let refused = |error: io::Error| VizError::Ffmpeg(error.to_string());
    // What plays everywhere has an even number of rows and columns, and colour at half the size.
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
    let mut said = String::new();
    if let Some(mut errors) = child.stderr.take() {
        errors.read_to_string(&mut said).map_err(refused)?;
    }
    let status = child.wait().map_err(refused)?;
    if !status.success() {
        let said = said.lines().next_back().unwrap_or("it gave no reason");
        return Err(VizError::Ffmpeg(said.to_owned()));
    }
    written.map_err(refused)
}
