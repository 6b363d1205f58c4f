//! The state of a training run and its checkpoint format. A resumed run gives the same bytes as an uninterrupted one.

use render::cpu::Isa;
use scene::frame::{self, Kind};
use scene::{CodecError, Splats, swing};
use serde::{Deserialize, Serialize};

use crate::coarse_to_fine::CoarseToFine;
use crate::exposure::ExposureTraining;
use crate::growth::DensificationStats;
use crate::optimiser::Adam;
use crate::pose::PoseTraining;
use crate::pose::path::PathTraining;
use crate::pose::sensors::{NUMBERS, SensorTraining};
use crate::swing::SwingTraining;

/// A checkpoint. The header is [`Header`]. The bulk holds, little endian:
/// - all columns of the splats, of the first and of the second Adam moments (f32);
/// - the densification error of each splat (f32);
/// - per trained exposure: view, steps (u32), then value, first and second moment (twelve f32 each);
/// - per trained pose: view, steps (u32), then displacement, first and second moment (six f32 each);
/// - per refined sensor: steps (u32), then numbers, first and second moment (eight f32 each);
/// - of a refined path: steps (u32), then mean squares and the motion at each time (six f32 each);
/// - of a swing: amplitudes, first and second moments (twelve f32 for each splat), and, until the stride is chosen, the sums of each
///   candidate and splat (six f32);
/// - all attributes of the splats (u32).
const CHECKPOINT: Kind = Kind(*b"ckpt", 9);

/// Everything that a training step depends on besides its job.
#[derive(Debug, Clone)]
pub struct State {
    /// Steps done.
    pub(crate) step: u32,
    /// Number of steps that were skipped because their loss was not finite.
    pub(crate) skipped: u32,
    /// Number of counted splats at the start.
    pub(crate) start_count: usize,
    pub(crate) coarse_to_fine: CoarseToFine,
    pub(crate) splats: Splats,
    pub(crate) adam: Adam,
    pub(crate) densification: DensificationStats,
    /// `Some` where exposures are trained.
    pub(crate) exposures: Option<ExposureTraining>,
    /// `Some` where poses are trained.
    pub(crate) poses: Option<PoseTraining>,
    /// `Some` where splats swing.
    pub(crate) swing: Option<SwingTraining>,
    /// Loss of the last step, for reports only. Not part of a checkpoint.
    pub(crate) loss: f64,
}

#[derive(Serialize, Deserialize)]
struct Header {
    step: u32,
    skipped: u32,
    start_count: u64,
    coarse_to_fine: CoarseToFine,
    adam_step: i32,
    sh_degree: u8,
    count: u64,
    /// Rows of densification statistics: all splats, or none since the last refinement.
    stats_count: u64,
    /// Number of exposures, where they are trained.
    exposure_count: Option<u64>,
    /// Number of poses, where they are trained.
    pose_count: Option<u64>,
    /// Number of sensors, where their errors are trained with the poses.
    sensor_count: Option<u64>,
    /// Number of times of the object's path, where it is refined with the poses.
    time_count: Option<u64>,
    /// Where splats swing.
    swing: Option<SwingHeader>,
    /// Names of the splats' attributes.
    attributes: Vec<String>,
}

/// As in [`SwingTraining`].
#[derive(Serialize, Deserialize)]
struct SwingHeader {
    power: Vec<f64>,
    frequency: Option<f64>,
    of_frequency: [f32; 2],
    steps: u32,
}

impl SwingHeader {
    /// 32-bit words of each splat, those of the values and those of the sums.
    fn words(&self) -> [usize; 2] {
        [3 * swing::NUMBERS, if self.frequency.is_some() { 0 } else { 6 * self.power.len() }]
    }
}

/// 32-bit words of an exposure in a checkpoint.
const EXPOSURE_WORDS: usize = 2 + 3 * 12;
/// 32-bit words of a pose in a checkpoint.
const POSE_WORDS: usize = 2 + 3 * 6;
/// 32-bit words of a sensor in a checkpoint.
const SENSOR_WORDS: usize = 1 + 3 * NUMBERS;
/// 32-bit words of a time of a path in a checkpoint, and of what all times share.
const TIME_WORDS: usize = 6;
const PATH_WORDS: usize = 1 + 6;

impl State {
    /// Steps done.
    pub fn step(&self) -> u32 {
        self.step
    }

    fn sensors(&self) -> Option<&SensorTraining> {
        self.poses.as_ref()?.sensors.as_ref()
    }

    fn path(&self) -> Option<&PathTraining> {
        self.poses.as_ref()?.path.as_ref()
    }

    /// Encodes a checkpoint.
    pub fn to_frame(&self) -> Vec<u8> {
        let (adam_step, first, second) = self.adam.parts();
        let header = Header {
            step: self.step,
            skipped: self.skipped,
            start_count: self.start_count as u64,
            coarse_to_fine: self.coarse_to_fine.clone(),
            adam_step,
            sh_degree: self.splats.sh_degree(),
            count: self.splats.len() as u64,
            stats_count: self.densification.error.len() as u64,
            exposure_count: self.exposures.as_ref().map(|exposures| exposures.views.len() as u64),
            pose_count: self.poses.as_ref().map(|poses| poses.views.len() as u64),
            sensor_count: self.sensors().map(|sensors| sensors.steps.len() as u64),
            time_count: self.path().map(|path| path.motions.len() as u64),
            swing: self.swing.as_ref().map(|swing| SwingHeader {
                power: swing.power.clone(),
                frequency: swing.frequency,
                of_frequency: swing.of_frequency,
                steps: swing.steps,
            }),
            attributes: self.splats.attribute_names(),
        };
        let columns = self.splats.columns().iter().chain(first).chain(second);
        let floats = columns.chain([&self.densification.error]).flatten();
        let mut bulk: Vec<u8> = floats.flat_map(|value| value.to_le_bytes()).collect();
        if let Some(ExposureTraining { views, steps, values }) = &self.exposures {
            write_rows(&mut bulk, views, steps, values);
        }
        if let Some(PoseTraining { views, steps, values, .. }) = &self.poses {
            write_rows(&mut bulk, views, steps, values);
        }
        if let Some(SensorTraining { steps, values }) = self.sensors() {
            write_rows(&mut bulk, &[], steps, values);
        }
        if let Some(PathTraining { steps, squares, motions }) = self.path() {
            bulk.extend(steps.to_le_bytes());
            bulk.extend(squares.iter().chain(motions.iter().flatten()).flat_map(|value| value.to_le_bytes()));
        }
        if let Some(SwingTraining { values, sums, .. }) = &self.swing {
            write_rows(&mut bulk, &[], &[], values);
            bulk.extend(sums.iter().flatten().flat_map(|value| value.to_le_bytes()));
        }
        let attributes = self.splats.attributes().iter().flat_map(|attribute| &attribute.values);
        bulk.extend(attributes.flat_map(|value| value.to_le_bytes()));
        frame::encode(CHECKPOINT, &header, &bulk)
    }

    /// Decodes a checkpoint.
    ///
    /// # Errors
    /// Bytes that are no checkpoint of this version, or are damaged.
    pub fn from_frame(bytes: &[u8]) -> Result<Self, CodecError> {
        let (header, bulk): (Header, _) = frame::decode(CHECKPOINT, bytes)?;
        let wrong = || CodecError::new("checkpoint columns do not fit the header");
        if header.sh_degree > 3 {
            return Err(wrong());
        }
        let columns = Splats::new(header.sh_degree).columns().len();
        // Check the announced sizes against the length before allocating.
        let words = u64::try_from(3 * columns).ok().and_then(|columns| columns.checked_mul(header.count));
        let words = words.and_then(|words| words.checked_add(header.stats_count));
        let exposed = header.exposure_count.unwrap_or(0);
        let words = words.and_then(|words| words.checked_add(exposed.checked_mul(EXPOSURE_WORDS as u64)?));
        let posed = header.pose_count.unwrap_or(0);
        let words = words.and_then(|words| words.checked_add(posed.checked_mul(POSE_WORDS as u64)?));
        let sensed = header.sensor_count.unwrap_or(0);
        let words = words.and_then(|words| words.checked_add(sensed.checked_mul(SENSOR_WORDS as u64)?));
        let timed = header
            .time_count
            .map_or(Some(0), |count| count.checked_mul(TIME_WORDS as u64)?.checked_add(PATH_WORDS as u64));
        let words = words.and_then(|words| words.checked_add(timed?));
        let swung = header.swing.as_ref().map_or([0; 2], SwingHeader::words).map(|words| words as u64);
        let swung = swung.map(|words| words.checked_mul(header.count));
        let words = swung.into_iter().fold(words, |words, more| words?.checked_add(more?));
        let attribute_words = (header.attributes.len() as u64).checked_mul(header.count);
        let words = words.and_then(|words| words.checked_add(attribute_words?));
        if words.and_then(|words| words.checked_mul(4)) != Some(bulk.len() as u64)
            || ![0, header.count].contains(&header.stats_count)
            || header.count == 0
        {
            return Err(wrong());
        }
        let (count, stats_count) = (header.count as usize, header.stats_count as usize);
        let (columns_bytes, rest) = bulk.split_at(4 * count * 3 * columns);
        let (stats_bytes, rest) = rest.split_at(4 * stats_count);
        let (exposure_bytes, rest) = rest.split_at(4 * EXPOSURE_WORDS * exposed as usize);
        let (pose_bytes, rest) = rest.split_at(4 * POSE_WORDS * posed as usize);
        let (sensor_bytes, rest) = rest.split_at(4 * SENSOR_WORDS * sensed as usize);
        let (path_bytes, rest) = rest.split_at(4 * timed.ok_or_else(wrong)? as usize);
        let [values_words, sums_words] = header.swing.as_ref().map_or([0; 2], SwingHeader::words);
        let (values_bytes, rest) = rest.split_at(4 * count * values_words);
        let (sums_bytes, attribute_bytes) = rest.split_at(4 * count * sums_words);
        let mut all = columns_bytes.chunks_exact(4 * count).map(floats);
        let splats = Splats::from_columns(all.by_ref().take(columns).collect()).ok_or_else(wrong)?;
        let splats = frame::with_attributes(splats, &header.attributes, attribute_bytes)?;
        let first = all.by_ref().take(columns).collect();
        let second = all.collect();
        let exposures = || {
            let (views, steps, values) = read_rows(exposure_bytes, exposed as usize);
            ExposureTraining { views, steps, values }
        };
        let poses = || {
            let (views, steps, values) = read_rows(pose_bytes, posed as usize);
            let sensors = header.sensor_count.map(|count| {
                let (steps, values) = read_values(sensor_bytes, count as usize);
                SensorTraining { steps, values }
            });
            let path = header.time_count.map(|_| {
                // The bytes are those of the steps and of the squares at least: their number was checked above.
                let (steps, rest) = path_bytes.split_at(4);
                let numbers = floats(rest);
                let mut rows = numbers.chunks_exact(6).map(|row| row.try_into().expect("6 numbers"));
                let squares = rows.next().expect("the squares");
                PathTraining { steps: integers(steps)[0], squares, motions: rows.collect() }
            });
            PoseTraining { views, steps, values, sensors, path }
        };
        let swing = header.swing.map(|SwingHeader { power, frequency, of_frequency, steps }| {
            let values = read_parts(values_bytes, count);
            let sums = floats(sums_bytes);
            let sums = sums.chunks_exact(6).map(|row| row.try_into().expect("6 numbers")).collect();
            SwingTraining::of(power, sums, frequency, of_frequency, steps, values)
        });
        Ok(Self {
            swing,
            step: header.step,
            skipped: header.skipped,
            start_count: usize::try_from(header.start_count).map_err(|_| wrong())?,
            coarse_to_fine: header.coarse_to_fine,
            splats,
            adam: Adam::from_parts(Isa::detect(), header.adam_step, first, second),
            densification: DensificationStats { error: floats(stats_bytes) },
            exposures: header.exposure_count.map(|_| exposures()),
            poses: header.pose_count.map(|_| poses()),
            loss: f64::NAN,
        })
    }
}

/// Appends numbers of views: the views, their Adam steps, and rows of values and moments.
fn write_rows<const N: usize>(bulk: &mut Vec<u8>, views: &[u32], steps: &[u32], values: &[Vec<[f32; N]>; 3]) {
    bulk.extend(views.iter().chain(steps).flat_map(|value| value.to_le_bytes()));
    bulk.extend(values.iter().flatten().flatten().flat_map(|value| value.to_le_bytes()));
}

/// Views, their Adam steps, and rows of values and moments.
type Rows<const N: usize> = (Vec<u32>, Vec<u32>, [Vec<[f32; N]>; 3]);

/// The inverse of [`write_rows`], for so many views. `chunks_exact` gives rows of N numbers only.
fn read_rows<const N: usize>(bytes: &[u8], count: usize) -> Rows<N> {
    let (views, rest) = bytes.split_at(4 * count);
    let (steps, values) = read_values(rest, count);
    (integers(views), steps, values)
}

/// Adam steps, and rows of values and moments, of so many.
fn read_values<const N: usize>(bytes: &[u8], count: usize) -> (Vec<u32>, [Vec<[f32; N]>; 3]) {
    let (steps, rest) = bytes.split_at(4 * count);
    (integers(steps), read_parts(rest, count))
}

/// Values, first and second moments of so many.
fn read_parts<const N: usize>(bytes: &[u8], count: usize) -> [Vec<[f32; N]>; 3] {
    let rows: Vec<[f32; N]> = floats(bytes).chunks_exact(N).map(|row| row.try_into().expect("N numbers")).collect();
    [0, 1, 2].map(|n| rows[n * count..(n + 1) * count].to_vec())
}

/// Words of four bytes; `chunks_exact` gives no others.
fn words(bytes: &[u8]) -> impl Iterator<Item = [u8; 4]> {
    bytes.chunks_exact(4).map(|bytes| bytes.try_into().expect("four bytes"))
}

fn floats(bytes: &[u8]) -> Vec<f32> {
    words(bytes).map(f32::from_le_bytes).collect()
}

fn integers(bytes: &[u8]) -> Vec<u32> {
    words(bytes).map(u32::from_le_bytes).collect()
}

#[cfg(test)]
mod tests {
    use glam::Vec3;
    use scene::Splat;

    use super::*;

    #[test]
    fn checkpoints_round_trip_and_damage_is_detected() {
        let mut splats = Splats::new(1);
        (0..20).for_each(|i| splats.push(&Splat::round(Vec3::splat(i as f32), -1.0, Vec3::splat(0.4), 0.3)));
        let moments = |add: f32| -> Vec<Vec<f32>> {
            let column = |(c, column): (usize, &Vec<f32>)| column.iter().map(|v| v * add + c as f32).collect();
            splats.columns().iter().enumerate().map(column).collect()
        };
        let stats = DensificationStats { error: (0..20).map(|i| i as f32).collect() };
        let exposures = ExposureTraining {
            views: vec![3, 8],
            steps: vec![7, 0],
            values: [1.0, 0.5, 0.25].map(|v| vec![[v; 12], [2.0 * v; 12]]),
        };
        for (densification, exposures) in [(stats, None), (DensificationStats::default(), Some(exposures))] {
            let adam = Adam::from_parts(Isa::detect(), 41, moments(0.5), moments(2.0));
            let (mut splats, coarse_to_fine) = (splats.clone(), CoarseToFine::default());
            if exposures.is_some() {
                splats.set_attribute("block", (1..=20).collect());
            }
            let loss = f64::NAN;
            let (step, skipped, start_count) = (40, 1, 7);
            let poses = exposures.is_some().then(|| PoseTraining {
                views: vec![1, 3, 8],
                steps: vec![7, 0, 2],
                values: [1.0, 0.5, 0.25].map(|v| vec![[v; 6], [2.0 * v; 6], [3.0 * v; 6]]),
                sensors: Some(SensorTraining {
                    steps: vec![5, 9],
                    values: [1.0, 0.5, 0.25].map(|v| vec![[v; NUMBERS], [4.0 * v; NUMBERS]]),
                }),
                path: Some(PathTraining { steps: 3, squares: [0.5; 6], motions: vec![[5.0; 6], [0.25; 6]] }),
            });
            let rows = |value: f32| (0..20).map(|i| [value * i as f32; swing::NUMBERS]).collect();
            let swing = match exposures.is_some() {
                true => {
                    SwingTraining::of(vec![0.5; 3], Vec::new(), Some(0.7), [0.1, 0.2], 9, [1.0, 2.0, 3.0].map(rows))
                }
                false => SwingTraining::of(vec![0.5; 3], vec![[0.25; 6]; 60], None, [0.0; 2], 0, [0.0; 3].map(rows)),
            };
            let swing = Some(swing);
            let state = State {
                step,
                skipped,
                start_count,
                coarse_to_fine,
                splats,
                adam,
                densification,
                exposures,
                poses,
                swing,
                loss,
            };
            let bytes = state.to_frame();
            let read = State::from_frame(&bytes).unwrap();
            assert_eq!((read.step, read.skipped, read.start_count), (40, 1, 7));
            assert!(read.splats == state.splats && read.adam.parts() == state.adam.parts());
            assert_eq!((&read.exposures, &read.poses), (&state.exposures, &state.poses));
            assert_eq!(read.swing, state.swing);
            assert_eq!(read.densification.error, state.densification.error);
            assert!(read.to_frame() == bytes);
            assert!(State::from_frame(&bytes[..bytes.len() - 4]).is_err());
            assert!(State::from_frame(&[]).is_err());
        }
        // A header that announces more than the bulk holds.
        for (count, exposure_count, pose_count, sensor_count, time_count, frequencies) in [
            (u64::MAX / 3, None, None, None, None, None),
            (1, Some(u64::MAX / 38), None, None, None, None),
            (1, Some(1), None, None, None, None),
            (1, None, Some(u64::MAX / 20), None, None, None),
            (1, None, Some(1), None, None, None),
            (1, None, None, Some(u64::MAX / 22), None, None),
            (1, None, None, Some(1), None, None),
            (1, None, None, None, Some(u64::MAX / 6), None),
            (1, None, None, None, Some(1), None),
            (1, None, None, None, None, Some(0)),
            (u64::MAX / 200, None, None, None, None, Some(9)),
        ] {
            let swing = frequencies.map(|count| SwingHeader {
                power: vec![0.0; count],
                frequency: None,
                of_frequency: [0.0; 2],
                steps: 0,
            });
            let header = Header {
                step: 1,
                skipped: 0,
                start_count: 0,
                coarse_to_fine: CoarseToFine::default(),
                adam_step: 1,
                sh_degree: 3,
                count,
                stats_count: 0,
                exposure_count,
                pose_count,
                sensor_count,
                time_count,
                swing,
                attributes: Vec::new(),
            };
            assert!(State::from_frame(&frame::encode(CHECKPOINT, &header, &[0; 64])).is_err());
        }
    }
}
