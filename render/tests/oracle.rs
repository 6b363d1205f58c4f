//! The CPU backend against float64 tensors of an independent program (gsplat's PyTorch projection, dense compositing,
//! autograd). The tensors are stored outside the repository.

mod reference;

use reference::tensors::{Case, case, planes};
use render::cpu::{Isa, Renderer};
use scene::column;

#[test]
fn images_and_gradients_agree_with_the_float64_oracle() {
    for name in ["tiny.npz", "small.npz", "medium.npz"] {
        let Some(case) = case(name) else { return };
        for isa in Isa::available() {
            let mut renderer = Renderer::new(isa);
            let frame = renderer.forward(&case.splats, &[], &case.camera, &case.options).clone();
            let gradients = renderer.backward(&case.splats, &case.upstream());
            case.compare(&format!("{name} {}", isa.name()), &frame, gradients);
        }
    }
}

#[test]
fn the_comparison_detects_a_moved_splat() {
    // Checks the test above: moving one splat must exceed its tolerance.
    let Some(Case { mut splats, camera, options, arrays }) = case("small.npz") else { return };
    splats.columns_mut()[column::MEAN][0] += 0.05;
    let frame = Renderer::default().forward(&splats, &[], &camera, &options).clone();
    let image = planes(&arrays["image"].1, 3);
    let worst = frame.colour.iter().zip(&image).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
    assert!(worst > 2e-3, "moving a splat changed the image by only {worst}");
}
