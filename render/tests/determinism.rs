//! Bit-identical results for every number of threads.

mod reference;

use reference::{Random, camera};
use render::cpu::{Isa, Renderer};
use render::{Options, Part, Upstream};
use scene::Splats;

/// Every number of a frame and of its gradients, as bits.
fn bits(isa: Isa, threads: usize, antialiased: bool) -> Vec<u32> {
    let camera = camera(250, 187, 220.0);
    let mut random = Random(11);
    let mut cloud = |count: usize| {
        let mut splats = Splats::new(1);
        for _ in 0..count {
            let pixel = [random.range(-20.0, 270.0), random.range(-20.0, 207.0)];
            let (z, sigma) = (random.range(1.0, 20.0), random.range(0.3, 6.0));
            splats.push(&random.splat(&camera, pixel, z, sigma));
        }
        splats
    };
    let (splats, context) = (cloud(5000), cloud(3000));
    let area = 250 * 187;
    let upstream = Upstream {
        colour: random.plane(3 * area),
        transmittance: random.plane(area),
        depth: random.plane(area),
        trainable_alpha: random.plane(area),
    };
    let options =
        Options { antialiased, sh_degree: 1, background: [0.1, 0.2, 0.3], extras: true, inverse_depth: false };
    let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().expect("threads");
    pool.install(|| {
        let mut renderer = Renderer::new(isa);
        let mut all = Vec::new();
        // Twice, to cover reused buffers.
        for _ in 0..2 {
            let frame = renderer.forward(&splats, &[Part::beside(&context)], &camera, &options);
            for plane in [&frame.colour, &frame.transmittance, &frame.depth, &frame.trainable_alpha] {
                all.extend(plane.iter().map(|v| v.to_bits()));
            }
            let gradients = renderer.backward(&splats, &upstream);
            let extra = [&gradients.screen_gradient, &gradients.screen_gradient_abs, &gradients.weight];
            for column in gradients.columns.iter().chain(extra) {
                all.extend(column.iter().map(|v| v.to_bits()));
            }
            all.extend(gradients.pose.iter().chain([&gradients.focal]).map(|v| v.to_bits()));
            all.extend(gradients.seen.iter().map(|&v| u32::from(v)));
        }
        let (first, second) = all.split_at(all.len() / 2);
        assert_eq!(first, second, "a second pass differs");
        all
    })
}

#[test]
fn one_two_and_five_threads_give_the_same_bits() {
    for isa in Isa::available() {
        for antialiased in [false, true] {
            let one = bits(isa, 1, antialiased);
            assert!(one.iter().filter(|&&v| v != 0).count() > one.len() / 2, "most values are zero");
            for threads in [2, 5] {
                // Not assert_eq, which would print a million numbers.
                assert!(one == bits(isa, threads, antialiased), "{} with {threads} threads differs", isa.name());
            }
        }
    }
}
