//! What a training step leaves to the next, and its bytes: training goes on from it as if it had never stopped.

use render::cpu::Isa;
use scene::frame::{self, Kind};
use scene::{CodecError, Splats};
use serde::{Deserialize, Serialize};

use crate::exposure::ExposureTraining;
use crate::growth::Evidence;
use crate::need::Need;
use crate::optimiser::Adam;

/// A checkpoint; the header is [`Header`], the bulk all columns of the splats and of both moments, then what was seen of each
/// splat since the last refinement: error, weight (f32) and views (u32); then of each
/// exposure under training its view, its steps (u32), itself and both moments (twelve f32 each).
const CHECKPOINT: Kind = Kind(*b"ckpt", 3);

/// All that a step depends on besides its job.
#[derive(Debug, Clone)]
pub struct State {
    /// Steps done.
    pub(crate) step: u32,
    /// Steps left out.
    pub(crate) skipped: u32,
    /// Splats that counted at first.
    pub(crate) start_count: usize,
    pub(crate) need: Need,
    pub(crate) splats: Splats,
    pub(crate) adam: Adam,
    pub(crate) evidence: Evidence,
    /// Where exposures are trained.
    pub(crate) exposures: Option<ExposureTraining>,
    /// Of the last step, for whoever watches: nothing depends on it, and no checkpoint holds it.
    pub(crate) loss: f64,
}

#[derive(Serialize, Deserialize)]
struct Header {
    step: u32,
    skipped: u32,
    start_count: u64,
    need: Need,
    adam_step: i32,
    sh_degree: u8,
    count: u64,
    /// Splats that there is evidence of: all, or none since the last refinement.
    evident: u64,
    /// Exposures, where they are trained.
    exposed: Option<u64>,
}

/// Words of an exposure under training.
const EXPOSURE_WORDS: usize = 2 + 3 * 12;

impl State {
    /// Steps done.
    pub fn step(&self) -> u32 {
        self.step
    }

    /// As bytes, little endian.
    pub fn to_frame(&self) -> Vec<u8> {
        let Evidence { error, weight, views } = &self.evidence;
        let (adam_step, first, second) = self.adam.parts();
        let header = Header {
            step: self.step,
            skipped: self.skipped,
            start_count: self.start_count as u64,
            need: self.need.clone(),
            adam_step,
            sh_degree: self.splats.sh_degree(),
            count: self.splats.len() as u64,
            evident: views.len() as u64,
            exposed: self.exposures.as_ref().map(|exposures| exposures.views.len() as u64),
        };
        let columns = self.splats.columns().iter().chain(first).chain(second);
        let floats = columns.chain([error, weight]).flatten().flat_map(|value| value.to_le_bytes());
        let mut bulk: Vec<u8> = floats.chain(views.iter().flat_map(|value| value.to_le_bytes())).collect();
        if let Some(ExposureTraining { views, steps, values }) = &self.exposures {
            bulk.extend(views.iter().chain(steps).flat_map(|value| value.to_le_bytes()));
            bulk.extend(values.iter().flatten().flatten().flat_map(|value| value.to_le_bytes()));
        }
        frame::encode(CHECKPOINT, &header, &bulk)
    }

    /// From such bytes.
    ///
    /// # Errors
    /// Bytes that are no checkpoint of this version, or are damaged.
    pub fn from_frame(bytes: &[u8]) -> Result<Self, CodecError> {
        let (header, bulk): (Header, _) = frame::decode(CHECKPOINT, bytes)?;
        let wrong = || CodecError::new("a checkpoint's columns do not fit its header");
        if header.sh_degree > 3 {
            return Err(wrong());
        }
        let columns = Splats::new(header.sh_degree).columns().len();
        // A product of what the file says must be what the file is before anything is made of it.
        let words = u64::try_from(3 * columns).ok().and_then(|columns| columns.checked_mul(header.count));
        let words = words.and_then(|words| words.checked_add(header.evident.checked_mul(3)?));
        let exposed = header.exposed.unwrap_or(0);
        let words = words.and_then(|words| words.checked_add(exposed.checked_mul(EXPOSURE_WORDS as u64)?));
        if words.and_then(|words| words.checked_mul(4)) != Some(bulk.len() as u64)
            || ![0, header.count].contains(&header.evident)
            || header.count == 0
        {
            return Err(wrong());
        }
        let (count, evident) = (header.count as usize, header.evident as usize);
        let (columns_bytes, rest) = bulk.split_at(4 * count * 3 * columns);
        let (evidence_bytes, exposure_bytes) = rest.split_at(4 * evident * 3);
        let word = |bytes: &[u8]| <[u8; 4]>::try_from(bytes).expect("four bytes");
        let floats =
            |bytes: &[u8]| -> Vec<f32> { bytes.chunks_exact(4).map(|bytes| f32::from_le_bytes(word(bytes))).collect() };
        let mut all = columns_bytes.chunks_exact(4 * count).map(floats);
        let splats = Splats::from_columns(all.by_ref().take(columns).collect()).ok_or_else(wrong)?;
        let first = all.by_ref().take(columns).collect();
        let second = all.collect();
        let part = |n: usize| &evidence_bytes[4 * evident * n..4 * evident * (n + 1)];
        let whole =
            |bytes: &[u8]| -> Vec<u32> { bytes.chunks_exact(4).map(|bytes| u32::from_le_bytes(word(bytes))).collect() };
        let exposures = || {
            let (views, rest) = exposure_bytes.split_at(4 * exposed as usize);
            let (steps, rest) = rest.split_at(4 * exposed as usize);
            let rows: Vec<[f32; 12]> =
                floats(rest).chunks_exact(12).map(|row| row.try_into().expect("twelve numbers")).collect();
            let part = |n: usize| rows[n * exposed as usize..(n + 1) * exposed as usize].to_vec();
            ExposureTraining { views: whole(views), steps: whole(steps), values: [part(0), part(1), part(2)] }
        };
        Ok(Self {
            step: header.step,
            skipped: header.skipped,
            start_count: usize::try_from(header.start_count).map_err(|_| wrong())?,
            need: header.need,
            splats,
            adam: Adam::from_parts(Isa::detect(), header.adam_step, first, second),
            evidence: Evidence { error: floats(part(0)), weight: floats(part(1)), views: whole(part(2)) },
            exposures: header.exposed.map(|_| exposures()),
            loss: f64::NAN,
        })
    }
}

#[cfg(test)]
mod tests {
    use glam::Vec3;
    use scene::Splat;

    use super::*;

    #[test]
    fn a_checkpoint_round_trips_and_damage_is_seen() {
        let mut splats = Splats::new(1);
        (0..20).for_each(|i| splats.push(&Splat::round(Vec3::splat(i as f32), -1.0, Vec3::splat(0.4), 0.3)));
        let moments = |add: f32| -> Vec<Vec<f32>> {
            let column = |(c, column): (usize, &Vec<f32>)| column.iter().map(|v| v * add + c as f32).collect();
            splats.columns().iter().enumerate().map(column).collect()
        };
        let evidence = Evidence { error: vec![0.5; 20], weight: vec![0.25; 20], views: (0..20).collect() };
        let exposures = ExposureTraining {
            views: vec![3, 8],
            steps: vec![7, 0],
            values: [1.0, 0.5, 0.25].map(|v| vec![[v; 12], [2.0 * v; 12]]),
        };
        for (evidence, exposures) in [(evidence, None), (Evidence::default(), Some(exposures))] {
            let adam = Adam::from_parts(Isa::detect(), 41, moments(0.5), moments(2.0));
            let (splats, need) = (splats.clone(), Need::default());
            let loss = f64::NAN;
            let state = State { step: 40, skipped: 1, start_count: 7, need, splats, adam, evidence, exposures, loss };
            let bytes = state.to_frame();
            let read = State::from_frame(&bytes).unwrap();
            assert_eq!((read.step, read.skipped, read.start_count), (40, 1, 7));
            assert!(read.splats == state.splats && read.adam.parts() == state.adam.parts());
            assert_eq!(read.evidence.views, state.evidence.views);
            assert_eq!(read.exposures, state.exposures);
            assert_eq!((&read.evidence.error, &read.evidence.weight), (&state.evidence.error, &state.evidence.weight));
            assert!(read.to_frame() == bytes);
            assert!(State::from_frame(&bytes[..bytes.len() - 4]).is_err());
            assert!(State::from_frame(&[]).is_err());
        }
        // A header that promises what the bulk does not have.
        for (count, exposed) in [(u64::MAX / 3, None), (1, Some(u64::MAX / 38)), (1, Some(1))] {
            let (sh_degree, evident) = (3, 0);
            let (step, need) = (1, Need::default());
            let header =
                Header { step, skipped: 0, start_count: 0, need, adam_step: 1, sh_degree, count, evident, exposed };
            assert!(State::from_frame(&frame::encode(CHECKPOINT, &header, &[0; 64])).is_err());
        }
    }
}
