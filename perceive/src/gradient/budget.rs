//! What a network may take. Every size is charged before it is allocated.

/// Most bytes of a network's weights, tensors and tables. Its gradients take as much as its tensors again, at most.
const MAX_MEMORY: usize = 1 << 30;
/// Most multiply-adds of a forward pass; YOLOv8x at 640 pixels has 1.3·10¹¹.
const MAX_WORK: usize = 1 << 38;

/// What is left.
pub(super) struct Budget {
    bytes: usize,
    work: usize,
}

impl Default for Budget {
    fn default() -> Self {
        Self { bytes: MAX_MEMORY, work: MAX_WORK }
    }
}

impl Budget {
    /// Charges 4-byte numbers; `None` is more than can be counted.
    pub(super) fn take(&mut self, numbers: Option<usize>) -> Result<(), String> {
        let left = numbers.and_then(|numbers| self.bytes.checked_sub(numbers.checked_mul(4)?));
        self.bytes = left.ok_or_else(|| format!("needs more than {} MiB", MAX_MEMORY >> 20))?;
        Ok(())
    }

    /// Charges multiply-adds.
    pub(super) fn work(&mut self, factors: &[usize]) -> Result<(), String> {
        let product = factors.iter().try_fold(1usize, |product, &factor| product.checked_mul(factor));
        let left = product.and_then(|product| self.work.checked_sub(product));
        self.work = left.ok_or_else(|| format!("needs more than {MAX_WORK} multiply-adds for a picture"))?;
        Ok(())
    }

    /// The multiply-adds charged so far.
    pub(super) fn worked(&self) -> usize {
        MAX_WORK - self.work
    }
}
