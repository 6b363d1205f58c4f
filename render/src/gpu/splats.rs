//! Splats on the device: their columns in four buffers (banks), as one binding is too small for all columns.

use std::sync::Arc;

use scene::splats::sh_coefficients;
use scene::{Rigid, Splats, column};

use super::buffer::Buffer;
use super::device::Gpu;
use super::error::GpuError;

/// First column of each bank, and the end: bank 0 holds the parameters and the constant SH coefficient, the others five
/// SH coefficients each.
const BANKS: [usize; 5] = [0, column::SH + 3, column::SH + 18, column::SH + 33, column::SH + 48];

/// Columns of floats on the device, in the order of [`scene::column`]. Column `k` of a bank begins at element `k ·
/// stride`.
#[derive(Debug)]
pub struct Columns {
    banks: [Buffer; 4],
    stride: usize,
    sh_degree: u8,
}

impl Columns {
    /// Zeroed columns for `capacity` splats.
    ///
    /// # Errors
    /// If a bank exceeds the adapter's binding limit or the memory cap.
    pub fn new(gpu: &Gpu, label: &str, sh_degree: u8, capacity: usize) -> Result<Self, GpuError> {
        let fit = max_splats(gpu.max_binding_bytes(), sh_degree);
        if capacity > fit {
            return Err(GpuError::TooManySplats { count: capacity, fit });
        }
        let stride = stride_of(capacity);
        let bank = |bank: usize| gpu.buffer(label, bank_bytes(sh_degree, bank, stride));
        Ok(Self { banks: [bank(0)?, bank(1)?, bank(2)?, bank(3)?], stride, sh_degree })
    }

    /// The four banks: columns 0..14, 14..29, 29..44, 44..59. Banks above the SH degree are unused buffers of minimum
    /// size.
    pub fn banks(&self) -> [&wgpu::Buffer; 4] {
        self.banks.each_ref().map(|bank| &**bank)
    }

    /// Elements from one column of a bank to the next.
    pub fn stride(&self) -> usize {
        self.stride
    }

    /// SH degree, 0 to 3; it determines the number of columns.
    pub fn sh_degree(&self) -> u8 {
        self.sh_degree
    }

    /// Overwrites the first rows, ahead of the next submission.
    ///
    /// # Errors
    /// A pending error of the device.
    pub fn write(&self, gpu: &Gpu, columns: &[Vec<f32>]) -> Result<(), GpuError> {
        columns.iter().enumerate().try_for_each(|(k, column)| {
            let (bank, offset) = self.location(k);
            gpu.upload(bank, offset, column)
        })
    }

    /// Waits for all submitted work and reads the first `count` rows.
    ///
    /// # Errors
    /// Any error of the submitted work.
    pub fn read(&self, gpu: &Gpu, count: usize) -> Result<Vec<Vec<f32>>, GpuError> {
        let mut columns = Vec::with_capacity(column::SH + 3 * sh_coefficients(self.sh_degree));
        for (bank, buffer) in self.banks.iter().enumerate() {
            let bank_columns = columns_of(self.sh_degree, bank);
            // One read per bank, up to the last row of its last column: every read waits for the device.
            let elements = bank_columns.saturating_sub(1) * self.stride + if bank_columns > 0 { count } else { 0 };
            let floats: Vec<f32> = gpu.read(buffer, 0, elements)?;
            columns.extend((0..bank_columns).map(|k| floats[k * self.stride..k * self.stride + count].to_vec()));
        }
        Ok(columns)
    }

    /// A column's bank and its byte offset there.
    fn location(&self, k: usize) -> (&wgpu::Buffer, u64) {
        let bank = (0..4).rev().find(|&bank| k >= BANKS[bank]).unwrap_or(0);
        (&self.banks[bank], 4 * ((k - BANKS[bank]) * self.stride) as u64)
    }
}

/// The stride of columns for so many splats.
pub(super) fn stride_of(capacity: usize) -> usize {
    capacity.max(1).next_multiple_of(64)
}

/// Bytes of a bank.
pub(super) fn bank_bytes(sh_degree: u8, bank: usize, stride: usize) -> u64 {
    4 * columns_of(sh_degree, bank) as u64 * stride as u64
}

/// Largest number of splats whose banks fit a binding of so many bytes.
pub(super) fn max_splats(binding_bytes: u64, sh_degree: u8) -> usize {
    let widest = (0..4).map(|bank| columns_of(sh_degree, bank)).max().unwrap_or(1);
    (binding_bytes / (4 * widest as u64)) as usize / 64 * 64
}

/// Number of columns of a bank at an SH degree.
fn columns_of(sh_degree: u8, bank: usize) -> usize {
    let columns = column::SH + 3 * sh_coefficients(sh_degree);
    columns.min(BANKS[bank + 1]).saturating_sub(BANKS[bank])
}

/// Frozen splats on the device that are drawn with the trainable ones, as [`Part`](crate::Part).
#[derive(Debug, Clone, Copy)]
pub struct GpuPart<'a> {
    /// The splats.
    pub splats: &'a GpuSplats,
    /// For each camera what takes their axes to the camera's, where theirs are not those of the trainable splats.
    pub cameras_from_part: Option<&'a [Rigid]>,
}

impl<'a> GpuPart<'a> {
    /// Splats in the axes of the trainable ones.
    pub fn beside(splats: &'a GpuSplats) -> Self {
        Self { splats, cameras_from_part: None }
    }
}

/// [`Splats`] on the device.
#[derive(Debug)]
pub struct GpuSplats {
    gpu: Arc<Gpu>,
    columns: Columns,
    count: usize,
}

impl GpuSplats {
    /// Copies splats to the device, with a capacity of at least `capacity`.
    ///
    /// # Errors
    /// See [`Columns::new`].
    pub fn upload(gpu: &Arc<Gpu>, splats: &Splats, capacity: usize) -> Result<Self, GpuError> {
        let columns = Columns::new(gpu, "splats", splats.sh_degree(), capacity.max(splats.len()))?;
        columns.write(gpu, splats.columns())?;
        Ok(Self { gpu: Arc::clone(gpu), columns, count: splats.len() })
    }

    /// Replaces the splats; reallocates if they exceed the capacity.
    ///
    /// # Errors
    /// See [`Columns::new`]. After an error the set is empty.
    pub fn replace(&mut self, splats: &Splats) -> Result<(), GpuError> {
        self.count = 0;
        if splats.len() > self.columns.stride || splats.sh_degree() != self.columns.sh_degree {
            // Frees the old columns first: both at once may not fit.
            self.columns = Columns::new(&self.gpu, "splats", 0, 0)?;
            self.columns = Columns::new(&self.gpu, "splats", splats.sh_degree(), splats.len() + splats.len() / 8)
                .or_else(|_| Columns::new(&self.gpu, "splats", splats.sh_degree(), splats.len()))?;
        }
        self.columns.write(&self.gpu, splats.columns())?;
        self.count = splats.len();
        Ok(())
    }

    /// Waits for all submitted work and copies the splats back.
    ///
    /// # Errors
    /// Any error of the submitted work.
    pub fn download(&self) -> Result<Splats, GpuError> {
        let columns = self.columns.read(&self.gpu, self.count)?;
        Splats::from_columns(columns).ok_or_else(|| GpuError::Failed("columns of unequal length".into()))
    }

    /// Number of splats.
    pub fn len(&self) -> usize {
        self.count
    }

    /// Whether there are no splats.
    pub fn is_empty(&self) -> bool {
        self.count == 0
    }

    /// SH degree, 0 to 3.
    pub fn sh_degree(&self) -> u8 {
        self.columns.sh_degree
    }

    /// Their columns.
    pub fn columns(&self) -> &Columns {
        &self.columns
    }
}
