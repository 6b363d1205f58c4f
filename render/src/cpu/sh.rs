//! Real spherical harmonics up to degree 3 and their derivatives, in Cartesian form on unit directions, with the
//! constants of the original 3DGS rasterizer (Kerbl et al. 2023, `forward.cu`).

use super::simd::Lanes;

const C1: f32 = 0.488_602_52;
const C2: [f32; 5] = [1.092_548_4, -1.092_548_4, 0.315_391_57, -1.092_548_4, 0.546_274_24];
const C3: [f32; 7] = [-0.590_043_6, 2.890_611_4, -0.457_045_8, 0.373_176_34, -0.457_045_8, 1.445_305_7, -0.590_043_6];

/// The basis functions of degrees 1 ..= `degree` at unit direction (x, y, z), without the constant one. Elements above
/// the degree are zero.
#[inline(always)]
pub(crate) fn basis<L: Lanes>(degree: u8, x: L, y: L, z: L) -> [L; 15] {
    let mut b = [L::zero(); 15];
    if degree >= 1 {
        b[0] = L::splat(-C1) * y;
        b[1] = L::splat(C1) * z;
        b[2] = L::splat(-C1) * x;
    }
    if degree >= 2 {
        let (xx, yy, zz) = (x * x, y * y, z * z);
        b[3] = L::splat(C2[0]) * x * y;
        b[4] = L::splat(C2[1]) * y * z;
        b[5] = L::splat(C2[2]) * (zz + zz - xx - yy);
        b[6] = L::splat(C2[3]) * x * z;
        b[7] = L::splat(C2[4]) * (xx - yy);
        if degree >= 3 {
            let (three, four) = (L::splat(3.0), L::splat(4.0));
            let four_zz = four * zz - xx - yy;
            b[8] = L::splat(C3[0]) * y * (three * xx - yy);
            b[9] = L::splat(C3[1]) * x * y * z;
            b[10] = L::splat(C3[2]) * y * four_zz;
            b[11] = L::splat(C3[3]) * z * (zz + zz - three * (xx + yy));
            b[12] = L::splat(C3[4]) * x * four_zz;
            b[13] = L::splat(C3[5]) * z * (xx - yy);
            b[14] = L::splat(C3[6]) * x * (xx - three * yy);
        }
    }
    b
}

/// `Σ s_k ∇b_k`: the gradient with respect to the direction, for a gradient `s` with respect to the basis values.
#[inline(always)]
pub(crate) fn basis_gradient<L: Lanes>(degree: u8, x: L, y: L, z: L, s: &[L; 15]) -> [L; 3] {
    let mut d = [L::zero(); 3];
    if degree >= 1 {
        d = [L::splat(-C1) * s[2], L::splat(-C1) * s[0], L::splat(C1) * s[1]];
    }
    if degree >= 2 {
        let two = L::splat(2.0);
        let (s3, s4, s5) = (L::splat(C2[0]) * s[3], L::splat(C2[1]) * s[4], two * L::splat(C2[2]) * s[5]);
        let (s6, s7) = (L::splat(C2[3]) * s[6], two * L::splat(C2[4]) * s[7]);
        d[0] = d[0] + s3 * y - s5 * x + s6 * z + s7 * x;
        d[1] = d[1] + s3 * x + s4 * z - s5 * y - s7 * y;
        d[2] = d[2] + s4 * y + two * s5 * z + s6 * x;
    }
    if degree >= 3 {
        let (two, three, six, eight) = (L::splat(2.0), L::splat(3.0), L::splat(6.0), L::splat(8.0));
        let (xx, yy, zz) = (x * x, y * y, z * z);
        let (xy, xz, yz) = (x * y, x * z, y * z);
        let (s8, s9, s10, s11) =
            (L::splat(C3[0]) * s[8], L::splat(C3[1]) * s[9], L::splat(C3[2]) * s[10], L::splat(C3[3]) * s[11]);
        let (s12, s13, s14) = (L::splat(C3[4]) * s[12], L::splat(C3[5]) * s[13], L::splat(C3[6]) * s[14]);
        let four_zz = L::splat(4.0) * zz;
        d[0] = d[0] + s8 * six * xy + s9 * yz - s10 * two * xy - s11 * six * xz
            + s12 * (four_zz - three * xx - yy)
            + s13 * two * xz
            + s14 * three * (xx - yy);
        d[1] = d[1] + s8 * three * (xx - yy) + s9 * xz + s10 * (four_zz - xx - three * yy)
            - s11 * six * yz
            - s12 * two * xy
            - s13 * two * yz
            - s14 * six * xy;
        d[2] = d[2]
            + s9 * xy
            + s10 * eight * yz
            + s11 * (six * zz - three * (xx + yy))
            + s12 * eight * xz
            + s13 * (xx - yy);
    }
    d
}
