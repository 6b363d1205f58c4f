//! Writes moving pictures: numbered PNGs in a folder, one animated PNG, or whatever ffmpeg makes of a file's name.

use std::io::{self, BufWriter, Read, Write};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};

use eval::write_png;
use image::RgbImage;
use scene::BadInput;

use crate::commands::export::make_parent;
use crate::failure::{Failure, make_folder};

type Writer = Box<png::Writer<BufWriter<std::fs::File>>>;

/// A moving picture that is being written. It is whole, or not there.
pub(crate) enum Film {
    /// One file a picture, `000000.png` and so on.
    Folder { path: PathBuf, written: usize },
    /// An animated PNG, which browsers play.
    Animated { path: PathBuf, part: PathBuf, writer: Option<Writer> },
    /// A program that encodes, and the name that its file gets at the end.
    Encoder { path: PathBuf, part: PathBuf, child: Child },
}

impl Film {
    /// A film of so many pictures of this size. A path that ends in `.mp4`, `.webm`, `.mkv` or `.mov` is for ffmpeg.
    ///
    /// # Errors
    /// ffmpeg is not installed, or files cannot be created.
    pub(crate) fn create(
        path: &Path,
        (width, height): (u32, u32),
        pictures: u32,
        per_second: f64,
    ) -> Result<Self, Failure> {
        let path = path.to_path_buf();
        let ending = path.extension().and_then(|ending| ending.to_str()).unwrap_or_default().to_ascii_lowercase();
        let part = || {
            let name = path.file_name().unwrap_or_default().to_string_lossy();
            path.with_file_name(format!(".{name}.part.{ending}"))
        };
        match ending.as_str() {
            "mp4" | "webm" | "mkv" | "mov" => {
                make_parent(&path)?;
                let part = part();
                let child = encoder(&part, (width, height), per_second).map_err(|error| match error.kind() {
                    io::ErrorKind::NotFound => Failure::from(BadInput::new(
                        path.display().to_string(),
                        "is written by ffmpeg, which is not there",
                        "install ffmpeg, or give a folder or a file that ends in .apng",
                    )),
                    _ => Failure::Work(format!("ffmpeg cannot be started: {error}")),
                })?;
                Ok(Self::Encoder { path, part, child })
            }
            "apng" | "png" => {
                make_parent(&path)?;
                let part = part();
                let file = std::fs::File::create(&part).map_err(|error| unwritten(&path, error))?;
                let mut encoder = png::Encoder::new(BufWriter::new(file), width, height);
                encoder.set_color(png::ColorType::Rgb);
                encoder.set_depth(png::BitDepth::Eight);
                encoder.set_compression(png::Compression::Fast);
                // At most 240 pictures a second: 24,000.
                let (over, under) = (100, (100.0 * per_second).round().clamp(1.0, f64::from(u16::MAX)) as u16);
                let animated = encoder.set_animated(pictures.max(1), 0);
                let delayed = animated.and_then(|()| encoder.set_frame_delay(over, under));
                let writer = delayed.and_then(|()| encoder.write_header()).map_err(|error| unwritten(&path, error))?;
                Ok(Self::Animated { path, part, writer: Some(Box::new(writer)) })
            }
            _ => {
                make_folder(&path)?;
                Ok(Self::Folder { path, written: 0 })
            }
        }
    }

    /// Appends a picture.
    ///
    /// # Errors
    /// A file that cannot be written, or an encoder that has stopped.
    pub(crate) fn push(&mut self, picture: &RgbImage) -> Result<(), Failure> {
        match self {
            Self::Folder { path, written } => {
                write_png(&path.join(format!("{written:06}.png")), picture)?;
                *written += 1;
                Ok(())
            }
            Self::Animated { path, writer, .. } => {
                let given = writer.as_mut().map_or(Ok(()), |writer| writer.write_image_data(picture.as_raw()));
                given.map_err(|error| unwritten(path, error))
            }
            Self::Encoder { path, child, .. } => {
                let given = child.stdin.as_mut().map_or(Ok(()), |input| input.write_all(picture.as_raw()));
                given.map_err(|error| stopped(path, child, &error.to_string()))
            }
        }
    }

    /// Gives the file its name.
    ///
    /// # Errors
    /// As [`push`](Self::push).
    pub(crate) fn finish(mut self) -> Result<(), Failure> {
        let (path, part) = match &mut self {
            Self::Folder { .. } => return Ok(()),
            Self::Animated { path, part, writer } => {
                let ended = writer.take().map_or(Ok(()), |writer| writer.finish());
                ended.map_err(|error| unwritten(path, error))?;
                (path, part)
            }
            Self::Encoder { path, part, child } => {
                drop(child.stdin.take());
                match child.wait() {
                    Ok(status) if status.success() => {}
                    Ok(status) => return Err(stopped(path, child, &status.to_string())),
                    Err(error) => return Err(stopped(path, child, &error.to_string())),
                }
                (path, part)
            }
        };
        std::fs::rename(part, &*path).map_err(|error| unwritten(path, error))
    }
}

impl Drop for Film {
    /// What is not finished leaves nothing behind.
    fn drop(&mut self) {
        match self {
            Self::Folder { .. } => {}
            Self::Animated { part, .. } => drop(std::fs::remove_file(part)),
            Self::Encoder { part, child, .. } => {
                let _ = child.kill();
                let _ = child.wait();
                let _ = std::fs::remove_file(part);
            }
        }
    }
}

/// ffmpeg, which reads pictures from its standard input.
fn encoder(part: &Path, (width, height): (u32, u32), per_second: f64) -> io::Result<Child> {
    let mut command = Command::new("ffmpeg");
    command.args(["-nostdin", "-loglevel", "error", "-y", "-f", "rawvideo", "-pix_fmt", "rgb24"]);
    command.args(["-s", &format!("{width}x{height}"), "-r", &per_second.to_string(), "-i", "pipe:0"]);
    // Most encoders take even sides only.
    command.args(["-vf", "pad=ceil(iw/2)*2:ceil(ih/2)*2", "-pix_fmt", "yuv420p"]).arg(part);
    command.stdin(Stdio::piped()).stdout(Stdio::null()).stderr(Stdio::piped()).spawn()
}

/// What ffmpeg says of its end.
fn stopped(path: &Path, child: &mut Child, how: &str) -> Failure {
    drop(child.stdin.take());
    let mut said = String::new();
    if let Some(errors) = child.stderr.take() {
        let _ = errors.take(1 << 16).read_to_string(&mut said);
    }
    let said = said.lines().last().unwrap_or(how).to_owned();
    Failure::Work(format!("{}: ffmpeg stopped: {said}", path.display()))
}

fn unwritten(path: &Path, error: impl std::fmt::Display) -> Failure {
    Failure::Work(format!("{} cannot be written: {error}", path.display()))
}
