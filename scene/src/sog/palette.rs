//! A palette of SH coefficients: k-means in two stages, as one stage would take the product of both numbers of centroids.

use crate::splats::{Splats, column, sh_coefficients};

/// Most entries.
const MAX_ENTRIES: usize = 1 << 14;
/// Splats per entry, where there are more than [`FEW`].
const SPLATS_PER_ENTRY: usize = 16;
/// As many splats keep an entry each.
const FEW: usize = 1024;
/// Passes of Lloyd's method in each stage.
const PASSES: usize = 6;
/// Rows at most that a stage's centroids are found with.
const SAMPLE: usize = 1 << 14;

/// The coefficients above degree 0 that stand for those of the splats.
pub(super) struct Palette {
    /// Values of each entry, channel fastest.
    pub(super) centroids: Vec<f32>,
    /// The entry of each splat.
    pub(super) labels: Vec<u16>,
    width: usize,
}

impl Palette {
    /// The palette of splats of an SH degree above 0.
    pub(super) fn of(splats: &Splats) -> Self {
        let width = 3 * (sh_coefficients(splats.sh_degree()) - 1);
        let count = splats.len();
        let columns = &splats.columns()[column::SH + 3..];
        let values: Vec<f32> = (0..count).flat_map(|i| columns.iter().map(move |column| column[i])).collect();
        let rows = Rows { values: &values, width };
        if count <= FEW {
            return Self { labels: (0..count as u16).collect(), centroids: values, width };
        }
        let entries = (count / SPLATS_PER_ENTRY).clamp(FEW, MAX_ENTRIES);
        let all: Vec<u32> = (0..count as u32).collect();
        let groups = rows.divided(&all, (entries as f64).sqrt().ceil() as usize);
        let mut palette = Self { centroids: Vec::new(), labels: vec![0; count], width };
        for group in groups {
            let share = (group.len() * entries / count).max(1).min(group.len());
            for part in rows.divided(&group, share) {
                let entry = palette.len() as u16;
                palette.centroids.extend(rows.mean(&part));
                part.iter().for_each(|&row| palette.labels[row as usize] = entry);
            }
        }
        palette
    }

    /// Number of entries.
    pub(super) fn len(&self) -> usize {
        self.centroids.len() / self.width
    }
}

/// Rows of values.
struct Rows<'a> {
    values: &'a [f32],
    width: usize,
}

impl Rows<'_> {
    fn row(&self, row: u32) -> &[f32] {
        &self.values[row as usize * self.width..][..self.width]
    }

    fn mean(&self, of: &[u32]) -> Vec<f32> {
        let mut sum = vec![0.0f64; self.width];
        for &row in of {
            sum.iter_mut().zip(self.row(row)).for_each(|(sum, &value)| *sum += f64::from(value));
        }
        sum.into_iter().map(|sum| (sum / of.len().max(1) as f64) as f32).collect()
    }

    /// These rows in at most `parts` parts of near ones, none of them empty.
    fn divided(&self, of: &[u32], parts: usize) -> Vec<Vec<u32>> {
        let sample: Vec<u32> = of.iter().step_by(of.len().div_ceil(SAMPLE).max(1)).copied().collect();
        let parts = parts.clamp(1, sample.len().max(1));
        // Splats are in an order of places, so that even steps start all over the chunk.
        let starts = (0..parts).map(|part| sample[part * sample.len() / parts]);
        let mut centroids: Vec<f32> = starts.flat_map(|row| self.row(row).iter().copied()).collect();
        for _ in 0..PASSES {
            for (part, rows) in
                self.assigned(&sample, &centroids).iter().enumerate().filter(|(_, rows)| !rows.is_empty())
            {
                centroids[part * self.width..][..self.width].copy_from_slice(&self.mean(rows));
            }
        }
        let mut divided = self.assigned(of, &centroids);
        divided.retain(|rows| !rows.is_empty());
        divided
    }

    /// The rows nearest to each centroid.
    fn assigned(&self, of: &[u32], centroids: &[f32]) -> Vec<Vec<u32>> {
        let mut parts = vec![Vec::new(); centroids.len() / self.width];
        for &row in of {
            let values = self.row(row);
            let mut nearest = (f32::INFINITY, 0);
            for (part, centroid) in centroids.chunks_exact(self.width).enumerate() {
                let squared = values.iter().zip(centroid).fold(0.0, |sum, (a, b)| sum + (a - b) * (a - b));
                if squared < nearest.0 {
                    nearest = (squared, part);
                }
            }
            parts[nearest.1].push(row);
        }
        parts
    }
}
