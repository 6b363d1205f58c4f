//! A loss of whole pictures beside the photometric one.

mod common;

use std::sync::Mutex;

use common::*;
use scene::{Pixels, Rect, Splats};
use train::{Flow, PictureLoss, Recipe, TrainError};

/// Half the mean square of a picture's blue, which the photos do not ask for; and what it was asked.
#[derive(Default)]
struct Blue {
    asked: Mutex<Vec<(u32, u8, Rect)>>,
    last: Mutex<Vec<f32>>,
}

impl PictureLoss for Blue {
    fn evaluate(
        &self,
        view: u32,
        mip: u8,
        rect: Rect,
        photo: &Pixels,
        picture: &[f32],
    ) -> Result<Option<(f64, Vec<f32>)>, String> {
        self.asked.lock().unwrap().push((view, mip, rect));
        *self.last.lock().unwrap() = picture.to_vec();
        if view == 7 {
            return Ok(None);
        }
        let first = 2 * photo.area();
        let scale = 1.0 / photo.area() as f32;
        let loss = picture[first..].iter().map(|blue| 0.5 * f64::from(scale * blue * blue)).sum();
        let slope = |(i, value): (usize, &f32)| if i < first { 0.0 } else { scale * value };
        Ok(Some((loss, picture.iter().enumerate().map(slope).collect())))
    }
}

fn recipe(weight: f32) -> Recipe {
    Recipe { picture_weight: weight, picture_from: 0.5, picture_every: 3, coarse: Vec::new(), ..Recipe::default() }
}

/// Trains with a weight; returns the splats and the mean loss over all views, asked once more.
fn fit(initial: &Splats, photos: &Photos, loss: &Blue, recipe: Recipe) -> (Splats, f64) {
    let picture_loss: Option<&dyn PictureLoss> = Some(loss);
    let splats = Setup { picture_loss, recipe, ..Setup::new(initial.clone(), photos) }.run();
    let of = |view: &train::TrainView| {
        let photo = &photos.0[view.view as usize];
        let found = Blue::default().evaluate(0, 0, view.rect, photo, &common::photo(&splats, view));
        found.unwrap().unwrap().0
    };
    let mean = views().iter().map(of).sum::<f64>() / 12.0;
    (splats, mean)
}

#[test]
fn training_lowers_it_in_the_steps_that_the_recipe_says() {
    let ground_truth = cloud(21, 150, 0.8);
    let (photos, initial, loss) = (photos(&ground_truth), perturbed(&ground_truth), Blue::default());
    let (plain, before) = fit(&initial, &photos, &loss, recipe(0.0));
    assert!(loss.asked.lock().unwrap().is_empty(), "a loss of no weight was computed");
    let (aligned, after) = fit(&initial, &photos, &loss, recipe(3.0));
    println!("the loss is {before:.4} without it, {after:.4} with it");
    assert!(plain != aligned && after < 0.9 * before, "{after} of {before}");
    let asked = std::mem::take(&mut *loss.asked.lock().unwrap());
    assert_eq!(asked.len(), 40, "every third of the last 120 steps");
    assert!(asked.iter().all(|(_, mip, rect)| (*mip, rect.width, rect.height) == (0, WIDTH, HEIGHT)));
    // Again, on other numbers of threads.
    for threads in [1, 3] {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        let (again, _) = pool.install(|| fit(&initial, &photos, &loss, recipe(3.0)));
        assert!(again == aligned, "{threads} threads give another result");
    }
}

#[test]
fn it_sees_the_photo_where_pixels_do_not_count() {
    let ground_truth = cloud(22, 120, 0.8);
    let mut photos = photos(&ground_truth);
    for photo in &mut photos.0 {
        photo.mask = Some((0..AREA).map(|i| if i % WIDTH as usize >= 43 { 0 } else { 255 }).collect());
        photo.weights = Some((0..AREA).map(|i| if i.is_multiple_of(WIDTH as usize) { 0.0 } else { 3.0 }).collect());
    }
    let loss = Blue::default();
    fit(&perturbed(&ground_truth), &photos, &loss, recipe(1.0));
    let picture = loss.last.lock().unwrap().clone();
    let (view, _, _) = *loss.asked.lock().unwrap().last().unwrap();
    let photo = &photos.0[view as usize];
    let differs = |i: usize| (picture[i] - f32::from(photo.rgb[i]) / 255.0).abs() > 1e-6;
    let counts = |i: usize| (1..43).contains(&(i % WIDTH as usize));
    assert!((0..3 * AREA).all(|i| counts(i) || !differs(i)), "a pixel that does not count is not the photo's");
    assert!((0..3 * AREA).filter(|&i| counts(i) && differs(i)).count() > 1000);
}

#[test]
fn a_loss_that_cannot_be_computed_ends_training() {
    struct Broken;
    impl PictureLoss for Broken {
        fn evaluate(&self, _: u32, _: u8, _: Rect, _: &Pixels, _: &[f32]) -> Result<Option<(f64, Vec<f32>)>, String> {
            Err("out of order".into())
        }
    }
    let ground_truth = cloud(23, 30, 0.8);
    let photos = photos(&ground_truth);
    let setup = Setup { picture_loss: Some(&Broken), recipe: recipe(1.0), ..Setup::new(ground_truth, &photos) };
    let error = setup.try_run(&|_| true, &mut |_| Flow::Continue).unwrap_err();
    assert_eq!(error, TrainError::PictureLoss("out of order".into()));
}
