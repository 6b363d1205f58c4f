//! The lanes in x86-64 registers: one of AVX-512 or two of AVX2. The module [`simd`](super) explains why calling the
//! intrinsics is safe.

use std::arch::x86_64::*;
use std::ops::{Add, Div, Mul, Neg, Sub};

use super::lanes::{EXP2, Lanes, operators};

/// One AVX-512 register.
#[derive(Clone, Copy)]
#[doc(hidden)]
pub struct Avx512(__m512);

impl Avx512 {
    #[inline(always)]
    fn add_lanes(self, b: Self) -> Self {
        Self(unsafe { _mm512_add_ps(self.0, b.0) })
    }
    #[inline(always)]
    fn sub_lanes(self, b: Self) -> Self {
        Self(unsafe { _mm512_sub_ps(self.0, b.0) })
    }
    #[inline(always)]
    fn mul_lanes(self, b: Self) -> Self {
        Self(unsafe { _mm512_mul_ps(self.0, b.0) })
    }
    #[inline(always)]
    fn div_lanes(self, b: Self) -> Self {
        Self(unsafe { _mm512_div_ps(self.0, b.0) })
    }
}

operators!(Avx512);

impl Lanes for Avx512 {
    #[inline(always)]
    fn splat(x: f32) -> Self {
        Self(unsafe { _mm512_set1_ps(x) })
    }
    #[inline(always)]
    fn load(from: &[f32; 16]) -> Self {
        Self(unsafe { _mm512_loadu_ps(from.as_ptr()) })
    }
    #[inline(always)]
    fn store(self, to: &mut [f32; 16]) {
        unsafe { _mm512_storeu_ps(to.as_mut_ptr(), self.0) }
    }
    #[inline(always)]
    fn fma(self, b: Self, c: Self) -> Self {
        Self(unsafe { _mm512_fmadd_ps(self.0, b.0, c.0) })
    }
    #[inline(always)]
    fn min(self, b: Self) -> Self {
        Self(unsafe { _mm512_min_ps(self.0, b.0) })
    }
    #[inline(always)]
    fn max(self, b: Self) -> Self {
        Self(unsafe { _mm512_max_ps(self.0, b.0) })
    }
    #[inline(always)]
    fn abs(self) -> Self {
        Self(unsafe { _mm512_abs_ps(self.0) })
    }
    #[inline(always)]
    fn sqrt(self) -> Self {
        Self(unsafe { _mm512_sqrt_ps(self.0) })
    }
    #[inline(always)]
    fn lt(self, b: Self) -> u16 {
        unsafe { _mm512_cmp_ps_mask::<_CMP_LT_OQ>(self.0, b.0) }
    }
    #[inline(always)]
    fn le(self, b: Self) -> u16 {
        unsafe { _mm512_cmp_ps_mask::<_CMP_LE_OQ>(self.0, b.0) }
    }
    #[inline(always)]
    fn select(mask: u16, a: Self, b: Self) -> Self {
        Self(unsafe { _mm512_mask_blend_ps(mask, b.0, a.0) })
    }
    #[inline(always)]
    fn exp2_at_most(self) -> Self {
        // `scalef` saturates.
        self.exp2_in_range()
    }
    #[inline(always)]
    fn exp2_in_range(self) -> Self {
        let whole = unsafe { _mm512_roundscale_ps::<0>(self.0) };
        let f = self - Self(whole);
        let mut p = Self::splat(EXP2[0]);
        for c in &EXP2[1..] {
            p = p.fma(f, Self::splat(*c));
        }
        Self(unsafe { _mm512_scalef_ps(p.0, whole) })
    }
    #[inline(always)]
    fn recip(self) -> Self {
        // 14 bits, then one Newton step: r·(2 - x·r).
        let r = Self(unsafe { _mm512_rcp14_ps(self.0) });
        let two_minus = Self(unsafe { _mm512_fnmadd_ps(self.0, r.0, _mm512_set1_ps(2.0)) });
        r * two_minus
    }
    #[inline(always)]
    fn sums(v: &[Self; 16]) -> Self {
        // A transposing reduction: after each round a register holds partial sums of twice as many vectors.
        let (low, high) = (Self::fold_eight(Self::fold_four(v, 0), Self::fold_four(v, 4)), {
            Self::fold_eight(Self::fold_four(v, 8), Self::fold_four(v, 12))
        });
        Self::fold_eight(low, high)
    }
}

impl Avx512 {
    #[inline(always)]
    fn fold_two(a: Self, b: Self) -> __m512d {
        unsafe { _mm512_castps_pd(_mm512_add_ps(_mm512_unpacklo_ps(a.0, b.0), _mm512_unpackhi_ps(a.0, b.0))) }
    }
    #[inline(always)]
    fn fold_four(v: &[Self; 16], i: usize) -> Self {
        let (ab, cd) = (Self::fold_two(v[i], v[i + 1]), Self::fold_two(v[i + 2], v[i + 3]));
        unsafe {
            let (low, high) = (_mm512_unpacklo_pd(ab, cd), _mm512_unpackhi_pd(ab, cd));
            Self(_mm512_add_ps(_mm512_castpd_ps(low), _mm512_castpd_ps(high)))
        }
    }
    #[inline(always)]
    fn fold_eight(a: Self, b: Self) -> Self {
        unsafe {
            let even = _mm512_shuffle_f32x4::<0b10_00_10_00>(a.0, b.0);
            let odd = _mm512_shuffle_f32x4::<0b11_01_11_01>(a.0, b.0);
            Self(_mm512_add_ps(even, odd))
        }
    }
}

/// Two AVX2 registers.
#[derive(Clone, Copy)]
#[doc(hidden)]
pub struct Avx2(__m256, __m256);

impl Avx2 {
    #[inline(always)]
    fn add_lanes(self, b: Self) -> Self {
        unsafe { Self(_mm256_add_ps(self.0, b.0), _mm256_add_ps(self.1, b.1)) }
    }
    #[inline(always)]
    fn sub_lanes(self, b: Self) -> Self {
        unsafe { Self(_mm256_sub_ps(self.0, b.0), _mm256_sub_ps(self.1, b.1)) }
    }
    #[inline(always)]
    fn mul_lanes(self, b: Self) -> Self {
        unsafe { Self(_mm256_mul_ps(self.0, b.0), _mm256_mul_ps(self.1, b.1)) }
    }
    #[inline(always)]
    fn div_lanes(self, b: Self) -> Self {
        unsafe { Self(_mm256_div_ps(self.0, b.0), _mm256_div_ps(self.1, b.1)) }
    }
    #[inline(always)]
    fn mask(half: u16) -> __m256 {
        unsafe {
            let bits = _mm256_setr_epi32(1, 2, 4, 8, 16, 32, 64, 128);
            let set = _mm256_and_si256(_mm256_set1_epi32(i32::from(half & 0xff)), bits);
            _mm256_castsi256_ps(_mm256_cmpeq_epi32(set, bits))
        }
    }
    #[inline(always)]
    fn bits(lo: __m256, hi: __m256) -> u16 {
        unsafe { (_mm256_movemask_ps(lo) as u16) | ((_mm256_movemask_ps(hi) as u16) << 8) }
    }
}

operators!(Avx2);

impl Lanes for Avx2 {
    #[inline(always)]
    fn splat(x: f32) -> Self {
        unsafe { Self(_mm256_set1_ps(x), _mm256_set1_ps(x)) }
    }
    #[inline(always)]
    fn load(from: &[f32; 16]) -> Self {
        unsafe { Self(_mm256_loadu_ps(from.as_ptr()), _mm256_loadu_ps(from.as_ptr().add(8))) }
    }
    #[inline(always)]
    fn store(self, to: &mut [f32; 16]) {
        unsafe {
            _mm256_storeu_ps(to.as_mut_ptr(), self.0);
            _mm256_storeu_ps(to.as_mut_ptr().add(8), self.1);
        }
    }
    #[inline(always)]
    fn fma(self, b: Self, c: Self) -> Self {
        unsafe { Self(_mm256_fmadd_ps(self.0, b.0, c.0), _mm256_fmadd_ps(self.1, b.1, c.1)) }
    }
    #[inline(always)]
    fn min(self, b: Self) -> Self {
        unsafe { Self(_mm256_min_ps(self.0, b.0), _mm256_min_ps(self.1, b.1)) }
    }
    #[inline(always)]
    fn max(self, b: Self) -> Self {
        unsafe { Self(_mm256_max_ps(self.0, b.0), _mm256_max_ps(self.1, b.1)) }
    }
    #[inline(always)]
    fn abs(self) -> Self {
        unsafe {
            let sign = _mm256_set1_ps(-0.0);
            Self(_mm256_andnot_ps(sign, self.0), _mm256_andnot_ps(sign, self.1))
        }
    }
    #[inline(always)]
    fn sqrt(self) -> Self {
        unsafe { Self(_mm256_sqrt_ps(self.0), _mm256_sqrt_ps(self.1)) }
    }
    #[inline(always)]
    fn lt(self, b: Self) -> u16 {
        unsafe { Self::bits(_mm256_cmp_ps::<_CMP_LT_OQ>(self.0, b.0), _mm256_cmp_ps::<_CMP_LT_OQ>(self.1, b.1)) }
    }
    #[inline(always)]
    fn le(self, b: Self) -> u16 {
        unsafe { Self::bits(_mm256_cmp_ps::<_CMP_LE_OQ>(self.0, b.0), _mm256_cmp_ps::<_CMP_LE_OQ>(self.1, b.1)) }
    }
    #[inline(always)]
    fn select(mask: u16, a: Self, b: Self) -> Self {
        unsafe { Self(_mm256_blendv_ps(b.0, a.0, Self::mask(mask)), _mm256_blendv_ps(b.1, a.1, Self::mask(mask >> 8))) }
    }
    // AVX2 comparisons give vector masks. These overrides keep them, as the conversion to a 16-bit mask and back
    // dominates a rasterizer's loop.
    #[inline(always)]
    fn where_le(self, a: Self, b: Self) -> Self {
        unsafe {
            let (lo, hi) = (_mm256_cmp_ps::<_CMP_LE_OQ>(a.0, b.0), _mm256_cmp_ps::<_CMP_LE_OQ>(a.1, b.1));
            Self(_mm256_and_ps(lo, self.0), _mm256_and_ps(hi, self.1))
        }
    }
    #[inline(always)]
    fn unless_le(self, a: Self, b: Self) -> Self {
        unsafe {
            let (lo, hi) = (_mm256_cmp_ps::<_CMP_LE_OQ>(a.0, b.0), _mm256_cmp_ps::<_CMP_LE_OQ>(a.1, b.1));
            Self(_mm256_andnot_ps(lo, self.0), _mm256_andnot_ps(hi, self.1))
        }
    }
    #[inline(always)]
    fn or_if_le(self, a: Self, b: Self, other: Self) -> Self {
        unsafe {
            let (lo, hi) = (_mm256_cmp_ps::<_CMP_LE_OQ>(a.0, b.0), _mm256_cmp_ps::<_CMP_LE_OQ>(a.1, b.1));
            Self(_mm256_blendv_ps(self.0, other.0, lo), _mm256_blendv_ps(self.1, other.1, hi))
        }
    }
    #[inline(always)]
    fn all_le(self, b: Self) -> bool {
        unsafe {
            let (lo, hi) = (_mm256_cmp_ps::<_CMP_LE_OQ>(self.0, b.0), _mm256_cmp_ps::<_CMP_LE_OQ>(self.1, b.1));
            _mm256_movemask_ps(_mm256_and_ps(lo, hi)) == 0xff
        }
    }
    #[inline(always)]
    fn exp2_in_range(self) -> Self {
        let whole = Self(Self::round(self.0), Self::round(self.1));
        let f = self - whole;
        let mut p = Self::splat(EXP2[0]);
        for c in &EXP2[1..] {
            p = p.fma(f, Self::splat(*c));
        }
        Self(Self::scale(p.0, whole.0), Self::scale(p.1, whole.1))
    }
    #[inline(always)]
    fn recip(self) -> Self {
        Self::splat(1.0) / self
    }
    #[inline(always)]
    fn sums(v: &[Self; 16]) -> Self {
        Self(Self::fold_eight(v, 0), Self::fold_eight(v, 8))
    }
}

impl Avx2 {
    #[inline(always)]
    fn fold_two(v: &[Self; 16], i: usize) -> __m256 {
        unsafe { _mm256_hadd_ps(_mm256_add_ps(v[i].0, v[i].1), _mm256_add_ps(v[i + 1].0, v[i + 1].1)) }
    }
    #[inline(always)]
    fn fold_four(v: &[Self; 16], i: usize) -> __m256 {
        unsafe { _mm256_hadd_ps(Self::fold_two(v, i), Self::fold_two(v, i + 2)) }
    }
    #[inline(always)]
    fn fold_eight(v: &[Self; 16], i: usize) -> __m256 {
        let (a, b) = (Self::fold_four(v, i), Self::fold_four(v, i + 4));
        unsafe { _mm256_add_ps(_mm256_permute2f128_ps::<0x20>(a, b), _mm256_permute2f128_ps::<0x31>(a, b)) }
    }
    #[inline(always)]
    fn round(v: __m256) -> __m256 {
        unsafe { _mm256_round_ps::<{ _MM_FROUND_TO_NEAREST_INT | _MM_FROUND_NO_EXC }>(v) }
    }
    /// p · 2^whole
    #[inline(always)]
    fn scale(p: __m256, whole: __m256) -> __m256 {
        unsafe {
            let exponent = _mm256_slli_epi32::<23>(_mm256_cvtps_epi32(whole));
            _mm256_castsi256_ps(_mm256_add_epi32(_mm256_castps_si256(p), exponent))
        }
    }
}
