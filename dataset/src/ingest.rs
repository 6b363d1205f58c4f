//! Ingests photos: decodes, undistorts and downscales each one and stores its mip pyramid as artefacts.
//!
//! Photos are identified by a hash of everything that their mips depend on. A record under that hash lists the mips of a photo
//! ingested before, from this or another capture, so a repeated ingest only reads and hashes files, and an interrupted one
//! resumes. A thread holds one photo at a time: peak memory depends on the size of photos and the number of threads, not on the
//! number of photos.

mod depths;
mod error;
mod from_map;
mod photo_files;
mod true_depth;
mod undistorter;

use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::{Mutex, PoisonError};

use scene::frame::{self, Kind};
use scene::{ArtefactId, BadInput, Camera, Capture, Pinhole, Pixels, View};
use serde::{Deserialize, Serialize};
use store::{BlockingStore, StoreError};

use self::depths::Depths;
pub use self::error::IngestError;
pub use self::from_map::Used;
use self::photo_files::{PhotoFiles, read};
pub use self::true_depth::{TrueDepth, ViewDepths};
pub(crate) use self::undistorter::{LastUndistorter, undistorter};
use crate::open::{Photo, Source};
use crate::photo::DecodedPhoto;
use crate::undistortion::Undistorter;
use crate::{box_masks, mip_tiles, mips, photo};

/// An ingested capture in the store.
pub const CAPTURE: Kind = Kind(*b"capt", 3);
/// The ingest record of a photo.
const RECORD: Kind = Kind(*b"memo", 1);
/// Part of the hash of a photo. Raise it with each change of decoding, undistortion, downscaling, mips or their format.
const FORMAT: u32 = 2;

/// How to ingest.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct IngestOptions {
    /// Photos are box-filtered by this factor: sides are divided and rounded down, intrinsics divided exactly. 1 keeps the size.
    pub downscale: u32,
    /// Photos processed concurrently, at least 1.
    pub threads: usize,
}

/// An ingested capture.
#[derive(Debug, Clone, PartialEq)]
pub struct Ingested {
    /// The capture, with the cameras of mip 0 and the mips of every view.
    pub capture: Capture,
    /// Artefact of the capture, a frame of kind [`CAPTURE`]. Equal photos, poses and options give an equal id.
    pub id: ArtefactId,
    /// Number of photos decoded; the others had an ingest record.
    pub decoded: usize,
    /// Number of depths from lidar and depth maps, in all views.
    pub depth_samples: usize,
    /// The depth maps behind them.
    pub depth_maps: Used,
}

/// Ingests all photos of a capture. `progress` is called with (photos done, photos in total) from any thread, one call at a
/// time, in order.
///
/// # Errors
/// The first photo, by name, that cannot be used, or a failing store. The next ingest reuses the photos stored so far.
pub fn ingest(
    source: &Source,
    store: &BlockingStore,
    options: &IngestOptions,
    progress: &(dyn Fn(usize, usize) + Sync),
) -> Result<Ingested, IngestError> {
    if options.downscale == 0 {
        return Err(BadInput::new("--downscale", "is 0", "give 1 to keep the photos as they are, or more").into());
    }
    let photos = &source.photos;
    if photos.len() != source.capture.views.len() {
        return Err(BadInput::new("the capture", "does not have one photo per view", "open it again").into());
    }
    let job = Job { store, downscale: options.downscale };
    let done = Mutex::new(0);
    let views = in_threads(options.threads, photos.len(), |i, kept: &mut Kept| {
        let view = job.view(&source.capture.views[i], &photos[i], kept)?;
        let mut done = done.lock().unwrap_or_else(PoisonError::into_inner);
        *done += 1;
        progress(*done, photos.len());
        Ok::<_, IngestError>(view)
    })?;
    let decoded = views.iter().filter(|(_, decoded)| *decoded).count();
    let views = views.into_iter().map(|(view, _)| view).collect();
    let mut capture = Capture { views, points: source.capture.points.clone(), geo_origin: source.capture.geo_origin };
    let depths = Depths::new(source, options.downscale);
    let concerned: Vec<usize> = (0..photos.len()).filter(|&view| depths.concerns(view)).collect();
    let measured = in_threads(options.threads, concerned.len(), |i, undistorter: &mut LastUndistorter| {
        let view = concerned[i];
        Ok::<_, IngestError>((view, depths.measure(&capture, view, store, undistorter)?))
    })?;
    let (depth_samples, maps) = depths::enter(&mut capture, measured);
    let names: Vec<&str> = capture.views.iter().map(|view| view.name.as_str()).collect();
    let depth_maps = from_map::check(maps, photos, &names)?;
    let id = store.put(frame::encode(CAPTURE, &capture, &[]))?;
    Ok(Ingested { capture, id, decoded, depth_samples, depth_maps })
}

/// The results of `work` for 0 to `count` in order, computed by this many threads, each of which keeps a state.
///
/// # Errors
/// The first one, by number. Threads take numbers in order, so it is among those taken, whichever thread fails first.
fn in_threads<S: Default, T: Send, E: Send>(
    threads: usize,
    count: usize,
    work: impl Fn(usize, &mut S) -> Result<T, E> + Sync,
) -> Result<Vec<T>, E> {
    let (next, failed) = (AtomicUsize::new(0), AtomicBool::new(false));
    let take = || (!failed.load(Ordering::Relaxed)).then(|| next.fetch_add(1, Ordering::Relaxed));
    let run = || {
        let (mut results, mut state) = (Vec::new(), S::default());
        while let Some(i) = take().filter(|&i| i < count) {
            let result = work(i, &mut state);
            failed.fetch_or(result.is_err(), Ordering::Relaxed);
            results.push((i, result));
        }
        results
    };
    let mut results = std::thread::scope(|scope| {
        let threads: Vec<_> = (1..threads.min(count)).map(|_| scope.spawn(run)).collect();
        let mut results = run();
        for thread in threads {
            results.extend(thread.join().unwrap_or_else(|panic| std::panic::resume_unwind(panic)));
        }
        results
    });
    results.sort_by_key(|(i, _)| *i);
    results.into_iter().map(|(_, result)| result).collect()
}

/// Loads an ingested capture.
///
/// # Errors
/// Not in the store, damaged, or not a capture.
pub fn load_capture(store: &BlockingStore, id: ArtefactId) -> Result<Capture, IngestError> {
    let bytes = store.get(id)?;
    let capture =
        frame::decode(CAPTURE, &bytes).and_then(|(capture, _): (Capture, _)| capture.check().map(|()| capture));
    let capture = capture
        .map_err(|error| BadInput::new(format!("artefact {id}"), error.to_string(), "ingest the capture again"))?;
    Ok(capture)
}

/// What a thread keeps from one photo to the next.
#[derive(Default)]
struct Kept {
    files: PhotoFiles,
    undistorter: LastUndistorter,
}

struct Job<'a> {
    store: &'a BlockingStore,
    downscale: u32,
}

/// The cached ingest of a photo.
#[derive(Serialize, Deserialize)]
struct IngestRecord {
    /// Artefacts, and their lengths in bytes.
    mips: Vec<(ArtefactId, u64)>,
    masked: bool,
}

impl Job<'_> {
    /// The view with its mips, and whether its photo was decoded.
    fn view(&self, view: &View, photo: &Photo, kept: &mut Kept) -> Result<(View, bool), IngestError> {
        let (w, h) = (photo.width, photo.height);
        let ideal = view.camera.pinhole;
        for (w, h) in [(w, h), (ideal.width, ideal.height)] {
            if !(1..=mip_tiles::MAX_PIXELS).contains(&(u64::from(w) * u64::from(h))) {
                let problem =
                    format!("has a camera of {w}×{h} pixels, which is none or over {}", mip_tiles::MAX_PIXELS);
                return Err(BadInput::new(photo.shown(), problem, "correct its camera's width and height").into());
            }
        }
        let pinhole = downscaled(ideal, self.downscale);
        if pinhole.width.min(pinhole.height) < mips::MIN_MIP_SIDE && self.downscale > 1 {
            let problem = format!("{} leaves less than {} pixels of {}", self.downscale, mips::MIN_MIP_SIDE, view.name);
            return Err(BadInput::new("--downscale", problem, "give a smaller factor").into());
        }
        let limit = photo::max_file_bytes(w, h);
        let bytes = kept.files.read(photo, limit)?;
        let mask = photo.mask.as_ref().map(|path| Ok::<_, BadInput>((path, read(path, limit)?))).transpose()?;
        let name = self.record_name(photo, &bytes, mask.as_ref().map(|(_, bytes)| bytes.as_slice()));
        let cached = self.load_record(&name)?;
        let decoded = cached.is_none();
        let record = match cached {
            Some(record) => record,
            None => {
                let mut pixels = photo::decode(&bytes, w, h).map_err(|e| at(photo.shown(), &e))?;
                drop(bytes);
                if let Some((path, bytes)) = mask {
                    let usable = photo::decode_mask(&bytes, w, h).map_err(|e| at(path.display().to_string(), &e))?;
                    pixels.mask = Some(intersected(pixels.mask.take(), usable));
                }
                let finest = self.finest(pixels, photo, undistorter(photo, ideal, &mut kept.undistorter)?);
                self.store_mips(finest, &name, photo)?
            }
        };
        let camera = Camera { pinhole, ..view.camera };
        Ok((
            View {
                name: view.name.clone(),
                camera,
                mips: record.mips.iter().map(|(id, _)| *id).collect(),
                masked: record.masked,
                depth: None,
            },
            decoded,
        ))
    }

    /// Mip 0: undistorted and downscaled. A mask that excludes nothing is dropped.
    fn finest(&self, mut photo: DecodedPhoto, source: &Photo, undistorter: &Undistorter) -> Pixels {
        if !undistorter.is_identity() {
            photo.mask = photo.mask.map(|mask| undistorter.nearest(&mask));
            photo.rgb = undistorter.rgb(&photo.rgb);
        }
        let Pinhole { width, height, .. } = undistorter.pinhole();
        let moving = source.moving();
        if !moving.is_empty() {
            let all = || vec![255; width as usize * height as usize];
            box_masks::exclude(photo.mask.get_or_insert_with(all), &undistorter.pinhole(), &moving);
        }
        let mut pixels =
            Pixels { width, height, rgb: photo::planes(&photo.rgb), mask: photo.mask, weights: None, depth: None };
        drop(photo.rgb);
        if self.downscale > 1 {
            pixels = mips::downscale(&pixels, self.downscale);
        }
        pixels.mask = pixels.mask.filter(|mask| mask.contains(&0));
        pixels
    }

    fn store_mips(&self, finest: Pixels, name: &str, photo: &Photo) -> Result<IngestRecord, IngestError> {
        let masked = finest.mask.is_some();
        let mut encoded = Vec::new();
        mips::for_each_mip(finest, |mip| {
            encoded.push(mip_tiles::encode(mip).map_err(|e| at(photo.shown(), &e))?);
            Ok::<_, IngestError>(())
        })?;
        let lengths: Vec<u64> = encoded.iter().map(|bytes: &Vec<u8>| bytes.len() as u64).collect();
        // Concurrently: a remote store has the same latency for a small mip as for a large one.
        let ids = self.store.put_all(encoded)?;
        let record = IngestRecord { mips: ids.into_iter().zip(lengths).collect(), masked };
        self.store.put_record(name, frame::encode(RECORD, &record, &[]))?;
        Ok(record)
    }

    /// The name of a photo's ingest record: a hash of everything that its mips depend on.
    fn record_name(&self, photo: &Photo, bytes: &[u8], mask: Option<&[u8]>) -> String {
        let mask = mask.map(ArtefactId::of);
        let key = (FORMAT, ArtefactId::of(bytes), mask, photo.model, photo.width, photo.height, self.downscale);
        let key = match photo.moving().as_slice() {
            [] => frame::encode(RECORD, &key, &[]),
            moving => frame::encode(RECORD, &(key, moving), &[]),
        };
        format!("ingest/{}", ArtefactId::of(&key))
    }

    /// The ingest record of this name, if the store has all of its mips at their full length.
    fn load_record(&self, name: &str) -> Result<Option<IngestRecord>, StoreError> {
        let Some(bytes) = self.store.get_record(name)? else { return Ok(None) };
        let Ok((record, _)) = frame::decode::<IngestRecord>(RECORD, &bytes) else { return Ok(None) };
        for &(id, length) in &record.mips {
            if self.store.size(id)? != Some(length) {
                return Ok(None);
            }
        }
        Ok(Some(record))
    }
}

/// The camera of a photo downscaled by [`IngestOptions::downscale`].
pub fn downscaled(pinhole: Pinhole, factor: u32) -> Pinhole {
    let n = f64::from(factor);
    Pinhole {
        width: pinhole.width / factor,
        height: pinhole.height / factor,
        fx: pinhole.fx / n,
        fy: pinhole.fy / n,
        cx: pinhole.cx / n,
        cy: pinhole.cy / n,
    }
}

/// A pixel is usable only if both masks say so.
fn intersected(mask: Option<Vec<u8>>, mut other: Vec<u8>) -> Vec<u8> {
    if let Some(mask) = mask {
        other.iter_mut().zip(mask).for_each(|(a, b)| *a &= b);
    }
    other
}

fn at(file: String, error: &scene::CodecError) -> BadInput {
    BadInput::new(file, error.to_string(), "replace the file or take its image out of the capture")
}

#[cfg(test)]
mod tests;
