//! Splats in the device's memory: columns in four banks, so that no binding holds more than fifteen of them.

use std::sync::Arc;

use scene::splats::sh_coefficients;
use scene::{Splats, column};

use super::device::Gpu;
use super::error::GpuError;
use super::memory::Buffer;

/// First column of each bank, and the end: parameters with the constant colour, then five coefficients each.
const BANKS: [usize; 5] = [0, column::SH + 3, column::SH + 18, column::SH + 33, column::SH + 48];

/// Columns of floats on the device, in the order of [`scene::column`]. Column `k` of a bank begins at entry `k · stride`.
#[derive(Debug)]
pub struct Columns {
    banks: [Buffer; 4],
    stride: usize,
    sh_degree: u8,
}

impl Columns {
    /// Zeros, for so many splats.
    ///
    /// # Errors
    /// Where that is more than the adapter binds, or memory is short.
    pub fn new(gpu: &Gpu, label: &str, sh_degree: u8, capacity: usize) -> Result<Self, GpuError> {
        let fit = most_splats(gpu.room(), sh_degree);
        if capacity > fit {
            return Err(GpuError::TooManySplats { count: capacity, fit });
        }
        let stride = stride_of(capacity);
        let bank = |bank: usize| gpu.buffer(label, bytes_of_bank(sh_degree, bank, stride));
        Ok(Self { banks: [bank(0)?, bank(1)?, bank(2)?, bank(3)?], stride, sh_degree })
    }

    /// The four banks: columns 0..14, 14..29, 29..44, 44..59. Those above the SH degree are small and hold nothing.
    pub fn banks(&self) -> [&wgpu::Buffer; 4] {
        self.banks.each_ref().map(|bank| &**bank)
    }

    /// Entries from a column of a bank to the next.
    pub fn stride(&self) -> usize {
        self.stride
    }

    /// 0 to 3: how many columns there are.
    pub fn sh_degree(&self) -> u8 {
        self.sh_degree
    }

    /// Overwrites the first rows. Takes effect before whatever is submitted next.
    ///
    /// # Errors
    /// What went wrong until now.
    pub fn write(&self, gpu: &Gpu, columns: &[Vec<f32>]) -> Result<(), GpuError> {
        columns.iter().enumerate().try_for_each(|(k, column)| {
            let (bank, offset) = self.place(k);
            gpu.upload(bank, offset, column)
        })
    }

    /// The first `count` rows, once everything submitted is done.
    ///
    /// # Errors
    /// What went wrong until then.
    pub fn read(&self, gpu: &Gpu, count: usize) -> Result<Vec<Vec<f32>>, GpuError> {
        let mut columns = Vec::with_capacity(column::SH + 3 * sh_coefficients(self.sh_degree));
        for (bank, buffer) in self.banks.iter().enumerate() {
            let of_bank = columns_of(self.sh_degree, bank);
            // At once, up to the last row wanted of the last column: every read waits for the device.
            let entries = of_bank.saturating_sub(1) * self.stride + if of_bank > 0 { count } else { 0 };
            let floats: Vec<f32> = gpu.read(buffer, 0, entries)?;
            columns.extend((0..of_bank).map(|k| floats[k * self.stride..k * self.stride + count].to_vec()));
        }
        Ok(columns)
    }

    /// A column's bank and its byte offset there.
    fn place(&self, k: usize) -> (&wgpu::Buffer, u64) {
        let bank = (0..4).rev().find(|&bank| k >= BANKS[bank]).unwrap_or(0);
        (&self.banks[bank], 4 * ((k - BANKS[bank]) * self.stride) as u64)
    }
}

/// Entries from a column to the next with room for so many splats.
pub(super) fn stride_of(capacity: usize) -> usize {
    capacity.max(1).next_multiple_of(64)
}

/// Bytes of a bank.
pub(super) fn bytes_of_bank(sh_degree: u8, bank: usize, stride: usize) -> u64 {
    4 * columns_of(sh_degree, bank) as u64 * stride as u64
}

/// How many splats fit where a binding holds so many bytes.
pub(super) fn most_splats(room: u64, sh_degree: u8) -> usize {
    let widest = (0..4).map(|bank| columns_of(sh_degree, bank)).max().unwrap_or(1);
    (room / (4 * widest as u64)) as usize / 64 * 64
}

/// How many columns of an SH degree lie in a bank.
fn columns_of(sh_degree: u8, bank: usize) -> usize {
    let columns = column::SH + 3 * sh_coefficients(sh_degree);
    columns.min(BANKS[bank + 1]).saturating_sub(BANKS[bank])
}

/// [`Splats`] on the device.
#[derive(Debug)]
pub struct GpuSplats {
    gpu: Arc<Gpu>,
    columns: Columns,
    count: usize,
}

impl GpuSplats {
    /// Copies splats to the device, with room for `capacity` of them (at least as many as there are).
    ///
    /// # Errors
    /// See [`Columns::new`].
    pub fn upload(gpu: &Arc<Gpu>, splats: &Splats, capacity: usize) -> Result<Self, GpuError> {
        let columns = Columns::new(gpu, "splats", splats.sh_degree(), capacity.max(splats.len()))?;
        columns.write(gpu, splats.columns())?;
        Ok(Self { gpu: Arc::clone(gpu), columns, count: splats.len() })
    }

    /// Other splats in the place of these; room is made where they are more.
    ///
    /// # Errors
    /// See [`Columns::new`]. After an error there are no splats.
    pub fn replace(&mut self, splats: &Splats) -> Result<(), GpuError> {
        self.count = 0;
        if splats.len() > self.columns.stride || splats.sh_degree() != self.columns.sh_degree {
            // The old ones first: both at once may be more than there is.
            self.columns = Columns::new(&self.gpu, "splats", 0, 0)?;
            self.columns = Columns::new(&self.gpu, "splats", splats.sh_degree(), splats.len() + splats.len() / 8)
                .or_else(|_| Columns::new(&self.gpu, "splats", splats.sh_degree(), splats.len()))?;
        }
        self.columns.write(&self.gpu, splats.columns())?;
        self.count = splats.len();
        Ok(())
    }

    /// Copies them back, once everything submitted is done.
    ///
    /// # Errors
    /// What went wrong until then.
    pub fn download(&self) -> Result<Splats, GpuError> {
        let columns = self.columns.read(&self.gpu, self.count)?;
        Splats::from_columns(columns).ok_or_else(|| GpuError::Failed("columns of unequal length".into()))
    }

    /// The number of splats.
    pub fn len(&self) -> usize {
        self.count
    }

    /// True without splats.
    pub fn is_empty(&self) -> bool {
        self.count == 0
    }

    /// 0 to 3.
    pub fn sh_degree(&self) -> u8 {
        self.columns.sh_degree
    }

    /// Their columns.
    pub fn columns(&self) -> &Columns {
        &self.columns
    }
}
