//! Prunes a scene of a few hundred splats, with photos rendered from the ground ground_truth.

use std::sync::{Arc, Mutex};

use glam::{DMat3, DQuat, DVec3, Vec3};
use render::cpu::Renderer;
use render::{Options, Part};
use scene::{Camera, Pinhole, Pixels, Rect, Rigid, Splat, Splats, column};
use train::importance::Order;
use train::prune::{ObjectJudge, ObjectTolerance, Pruned, Pruning, keep, to_share, within_tolerance};
use train::{Backend, Flow, Job, PictureLoss, Recipe, TrainError, TrainView, WindowSource, metrics, random};

const WIDTH: u32 = 64;
const HEIGHT: u32 = 48;
const AREA: usize = (WIDTH * HEIGHT) as usize;

struct Photos(Vec<Arc<Pixels>>);

impl WindowSource for Photos {
    fn window(&self, view: u32, mip: u8, rect: Rect) -> Result<Arc<Pixels>, String> {
        let whole = Rect { x: 0, y: 0, width: WIDTH, height: HEIGHT };
        assert_eq!((mip, rect), (0, whole), "pruning reads the windows of the job");
        self.0.get(view as usize).cloned().ok_or_else(|| format!("view {view} is missing"))
    }
}

/// Ten cameras on a ring around the origin, looking at it from changing heights.
fn views() -> Vec<TrainView> {
    let view = |n: u32| {
        let (sin, cos) = (f64::from(n) / 10.0 * std::f64::consts::TAU).sin_cos();
        let centre = DVec3::new(5.0 * cos, 5.0 * sin, f64::from(n % 3) - 0.5);
        let forward = -centre.normalize();
        let right = forward.cross(DVec3::Z).normalize();
        let rotation = DQuat::from_mat3(&DMat3::from_cols(right, forward.cross(right), forward).transpose());
        let pinhole = Pinhole { width: WIDTH, height: HEIGHT, fx: 70.0, fy: 70.0, cx: 32.0, cy: 24.0 };
        let camera = Camera { pinhole, camera_from_world: Rigid { rotation, translation: rotation * -centre } };
        TrainView { view: n, mip: 0, rect: camera.full(), camera, camera_from_context: None }
    };
    (0..10).map(view).collect()
}

/// Coloured splats in a ball; every number from `key`.
fn cloud(key: u64, count: usize, opacity: f32) -> Splats {
    let mut splats = Splats::new(1);
    for i in 0..count as u64 {
        let number = |k: u64| random::uniform(key, 16 * i + k);
        let position = Vec3::new(number(0), number(1), number(2)) * 2.4 - 1.2;
        let colour = Vec3::new(number(3), number(4), number(5));
        splats.push(&Splat::round(position, (0.1 + 0.1 * number(6)).ln(), colour, opacity));
    }
    splats
}

/// The ground ground_truth with perturbed colours, so that its PSNR is finite, plus half as many nearly transparent
/// splats.
fn with_faint_splats(ground_truth: &Splats) -> Splats {
    let mut splats = ground_truth.clone();
    for (i, value) in splats.columns_mut()[column::SH].iter_mut().enumerate() {
        *value += 2.0 * (random::uniform(77, i as u64) - 0.5);
    }
    splats.append(&cloud(78, ground_truth.len() / 2, 0.01));
    splats
}

fn render(splats: &Splats, context: Option<&Splats>, view: &TrainView) -> Vec<f32> {
    let options = Options { sh_degree: 1, ..Options::default() };
    Renderer::default().forward(splats, context.map(Part::beside).as_slice(), &view.camera, &options).colour.clone()
}

fn photos(splats: &Splats) -> Photos {
    let bytes = |planes: Vec<f32>| planes.iter().map(|v| (v.clamp(0.0, 1.0) * 255.0).round() as u8).collect();
    let photo = |view| Pixels {
        width: WIDTH,
        height: HEIGHT,
        rgb: bytes(render(splats, None, view)),
        mask: None,
        ..Pixels::default()
    };
    Photos(views().iter().map(|view| Arc::new(photo(view))).collect())
}

/// Mean PSNR over the views.
fn psnr(splats: &Splats, photos: &Photos) -> f64 {
    let views = views();
    let of = |(view, photo): (&TrainView, &Arc<Pixels>)| {
        let ground_truth: Vec<f32> = photo.rgb.iter().map(|&b| f32::from(b) / 255.0).collect();
        let shown: Vec<f32> = render(splats, None, view).iter().map(|v| v.clamp(0.0, 1.0)).collect();
        metrics::psnr(&shown, &ground_truth, photo.mask.as_deref()).unwrap_or(0.0)
    };
    views.iter().zip(&photos.0).map(of).sum::<f64>() / views.len() as f64
}

type Predicate<'a> = &'a (dyn Fn(Vec3) -> bool + Sync);

fn with_job<R>(
    initial: &Splats,
    context: Option<&Splats>,
    photos: &Photos,
    counts: Predicate,
    work: impl FnOnce(Job) -> R,
) -> R {
    let (views, recipe) = (views(), Recipe::refinement(1.0));
    work(Job {
        initial: initial.clone(),
        context,
        views: &views,
        counts,
        keeps: &|_| true,
        free_space: None,
        budget: initial.len(),
        // Enough for all rounds: shorter jobs have fewer.
        steps: 1400,
        antialiased: false,
        seed: 3,
        size_bounds_metres: [1e-3, 2.0],
        exposures: None,
        trains_exposures: false,
        trains_poses: false,
        sensors: None,
        path: None,
        recipe: &recipe,
        source: photos,
        picture_loss: None,
        backend: &Backend::Cpu,
    })
}

fn prune(initial: &Splats, photos: &Photos, counts: Predicate, tolerance_db: f64) -> (Splats, Pruned) {
    with_job(initial, None, photos, counts, |job| {
        within_tolerance(job, &Pruning::within(tolerance_db), None, &mut |_| Flow::Continue).expect("pruning succeeds")
    })
}

#[test]
fn faint_splats_are_removed_within_the_tolerance() {
    let ground_truth = cloud(1, 120, 0.8);
    let photos = photos(&ground_truth);
    let model = with_faint_splats(&ground_truth);
    let (pruned, outcome) = prune(&model, &photos, &|_| true, 0.1);
    let (before, after) = (psnr(&model, &photos), psnr(&pruned, &photos));
    println!("{} splats at {before:.2} dB, {} at {after:.2}", model.len(), pruned.len());
    assert!(before < 40.0 && after >= before - 0.1 - 1e-6, "{before} {after}");
    assert!((outcome.psnr[0] - before).abs() < 1e-4 && (outcome.psnr[1] - after).abs() < 1e-4, "{outcome:?}");
    assert_eq!(outcome.splats, [model.len(), pruned.len()]);
    // The faint third is removed and most of the ground ground_truth is kept.
    assert!(pruned.len() <= ground_truth.len() && pruned.len() > ground_truth.len() / 4, "{}", pruned.len());
    let (more, _) = prune(&model, &photos, &|_| true, 1.0);
    assert!(more.len() < pruned.len(), "a wider tolerance allows fewer splats: {}", more.len());
}

#[test]
fn result_does_not_depend_on_threads() {
    let ground_truth = cloud(2, 80, 0.8);
    let photos = photos(&ground_truth);
    let run = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| prune(&with_faint_splats(&ground_truth), &photos, &|_| true, 0.2).0)
    };
    assert!(run(1) == run(3));
}

#[test]
fn only_counted_splats_are_removed() {
    let ground_truth = cloud(3, 100, 0.8);
    let photos = photos(&ground_truth);
    let model = with_faint_splats(&ground_truth);
    let left = |splats: &Splats| (0..splats.len()).filter(|&i| splats.mean(i).x < 0.0).count();
    let (pruned, outcome) = prune(&model, &photos, &|p| p.x >= 0.0, 0.2);
    // Recovery moves splats by a small part of their size, so hardly any crosses the border.
    assert!(left(&pruned).abs_diff(left(&model)) <= 2, "{} {}", left(&pruned), left(&model));
    assert!(outcome.splats[1] + 10 < outcome.splats[0], "{outcome:?}");
}

#[test]
fn holes_in_front_of_the_context_count_as_error() {
    // Green splats in front of a red context, and green photos. Where they are removed the pixel is red and no longer
    // theirs.
    let mut green = Splats::new(0);
    let mut red = Splats::new(0);
    for i in 0..60 {
        let number = |k: u64| random::uniform(5, 4 * i + k) * 2.0 - 1.0;
        let place = Vec3::new(number(0), number(1), number(2)).normalize();
        green.push(&Splat::round(place, 0.35f32.ln(), Vec3::new(0.1, 0.9, 0.1), 0.9));
        red.push(&Splat::round(place * 0.3, 0.3f32.ln(), Vec3::new(0.9, 0.1, 0.1), 0.9));
    }
    let shell = green.len();
    // Under 1/255, which no pixel shows.
    green.append(&cloud(9, 20, 0.003).with_sh_degree(0));
    let photos = photos(&green);
    let (pruned, outcome) = with_job(&green, Some(&red), &photos, &|_| true, |job| {
        within_tolerance(job, &Pruning::within(0.1), None, &mut |_| Flow::Continue).unwrap()
    });
    let worst = |splats: &Splats| {
        let red_at = |view| render(splats, Some(&red), view)[..AREA].iter().filter(|v| **v > 0.6).count();
        views().iter().map(red_at).max().unwrap_or(0)
    };
    assert!(outcome.splats[1] <= shell, "invisible splats are removed: {outcome:?}");
    assert!(worst(&Splats::new(0)) > 100, "the context alone must be visible");
    assert!(worst(&pruned) <= worst(&green) + 10, "{} of {}", worst(&pruned), worst(&green));
}

#[test]
fn masked_pixels_protect_no_splats() {
    let ground_truth = cloud(4, 80, 0.8);
    let mut photos = photos(&ground_truth);
    let masked = |photo: &Arc<Pixels>| {
        // Masks all but the left columns.
        let mask = (0..AREA).map(|i| if i % WIDTH as usize > 20 { 0 } else { 255 }).collect();
        Arc::new(Pixels { mask: Some(mask), ..Pixels::clone(photo) })
    };
    let (whole, _) = prune(&with_faint_splats(&ground_truth), &photos, &|_| true, 0.1);
    photos.0 = photos.0.iter().map(masked).collect();
    let model = with_faint_splats(&ground_truth);
    let (corner, outcome) = prune(&model, &photos, &|_| true, 0.1);
    assert!(corner.len() < whole.len(), "{} {}", corner.len(), whole.len());
    assert!((outcome.psnr[0] - psnr(&model, &photos)).abs() < 1e-4);
}

#[test]
fn zones_have_a_tolerance_of_their_own() {
    const TOLERANCE_DB: f64 = 2.0;
    // A faint object at the centre of every photo, below much else.
    let mut ground_truth = cloud(11, 120, 0.8);
    ground_truth.columns_mut()[column::MEAN + 2].iter_mut().for_each(|z| *z += 1.6);
    for i in 0..30 {
        let number = |k: u64| random::uniform(12, 8 * i + k);
        let place = (Vec3::new(number(0), number(1), number(2)) - 0.5) * 0.5;
        let colour = Vec3::new(number(3), number(4), number(5));
        ground_truth.push(&Splat::round(place, 0.05f32.ln(), colour, 0.2));
    }
    let all = photos(&ground_truth);
    let model = with_faint_splats(&ground_truth);
    let in_zone = |i: usize| (26..38).contains(&(i % WIDTH as usize)) && (18..30).contains(&(i / WIDTH as usize));
    let of_all =
        |change: &dyn Fn(&Pixels) -> Pixels| Photos(all.0.iter().map(|photo| Arc::new(change(photo))).collect());
    // A weight that changes next to nothing but says where the zone is.
    let weights: Vec<f32> = (0..AREA).map(|i| if in_zone(i) { 1.001 } else { 1.0 }).collect();
    let with_zones = of_all(&|photo| Pixels { weights: Some(weights.clone()), ..photo.clone() });
    let zone: Vec<u8> = (0..AREA).map(|i| if in_zone(i) { 255 } else { 0 }).collect();
    let zone_only = of_all(&|photo| Pixels { mask: Some(zone.clone()), ..photo.clone() });
    let [plain, aware] = [&all, &with_zones].map(|photos| prune(&model, photos, &|_| true, TOLERANCE_DB).0);
    let [of_plain, of_aware] = [&plain, &aware].map(|splats| psnr(splats, &zone_only));
    println!("zone {of_plain:.2} dB of {} splats, {of_aware:.2} of {}", plain.len(), aware.len());
    assert!(of_plain < of_aware - 1.0, "{of_plain} {of_aware}");
    assert!(plain.len() < aware.len() && aware.len() < model.len());
}

#[test]
fn the_most_important_share_is_kept() {
    let ground_truth = cloud(6, 60, 0.8);
    let photos = photos(&ground_truth);
    let model = with_faint_splats(&ground_truth);
    let (kept, outcome) = with_job(&model, None, &photos, &|_| true, |job| {
        to_share(job, &Pruning::within(0.1), 2.0 / 3.0, &mut |_| Flow::Continue).unwrap()
    });
    assert_eq!((kept.len(), outcome.splats), (60, [90, 60]));
    assert!(kept.col(column::OPACITY).iter().all(|logit| *logit > 0.0), "the faint splats are removed");

    let importance: Vec<f64> = (0..10).map(|i| f64::from(i % 5)).collect();
    let few = keep(&cloud(7, 10, 0.5), &importance, 0.5, &|_| true);
    let all = cloud(7, 10, 0.5);
    assert_eq!(few, all.select(&[2, 3, 4, 8, 9]), "earlier rows win ties, rows keep their order");
    assert_eq!(keep(&all, &importance, 1.0, &|_| true), all);
    assert!(keep(&all, &importance, 0.0, &|_| true).is_empty());
}

#[test]
fn stopping_returns_the_last_kept_splats_and_errors_are_reported() {
    let ground_truth = cloud(8, 60, 0.8);
    let photos = photos(&ground_truth);
    let model = with_faint_splats(&ground_truth);
    let pruning = Pruning::within(0.1);
    let (stopped, outcome) = with_job(&model, None, &photos, &|_| true, |job| {
        within_tolerance(job, &pruning, None, &mut |now| if now.step == 3 { Flow::Stop } else { Flow::Continue })
            .unwrap()
    });
    assert!(stopped == model && outcome.rounds == 0, "the first round was not finished");
    let failed = with_job(&model, None, &photos, &|_| true, |job| {
        within_tolerance(Job { views: &[], ..job }, &pruning, None, &mut |_| Flow::Continue).unwrap_err()
    });
    assert_eq!(failed, TrainError::NoViews);
    let none = Photos(Vec::new());
    let failed = with_job(&model, None, &none, &|_| true, |job| {
        within_tolerance(job, &Pruning { order: Order::Surface, ..pruning }, None, &mut |_| Flow::Continue).unwrap_err()
    });
    assert!(matches!(failed, TrainError::Source(line) if line.contains("missing")));
}

/// Notes the views that steps train on.
#[derive(Default)]
struct Trained(Mutex<Vec<u32>>);

impl PictureLoss for Trained {
    fn evaluate(&self, view: u32, _: u8, _: Rect, _: &Pixels, _: &[f32]) -> Result<Option<(f64, Vec<f32>)>, String> {
        self.0.lock().unwrap().push(view);
        Ok(None)
    }
}

#[test]
fn only_the_last_recovery_trains_on_views_that_judge() {
    let ground_truth = cloud(13, 60, 0.8);
    let photos = photos(&ground_truth);
    let trained = Trained::default();
    let recipe = Recipe { picture_weight: 1.0, picture_every: 1, ..Recipe::refinement(1.0) };
    let mut before_the_last = 0;
    let pruning = Pruning::within(0.1);
    with_job(&with_faint_splats(&ground_truth), None, &photos, &|_| true, |job| {
        let job = Job { recipe: &recipe, picture_loss: Some(&trained), ..job };
        within_tolerance(job, &pruning, None, &mut |now| {
            if now.step <= now.steps - now.recovery.steps {
                before_the_last = trained.0.lock().unwrap().len();
            }
            Flow::Continue
        })
        .unwrap()
    });
    let trained = trained.0.into_inner().unwrap();
    let judges = |of: &[u32]| of.iter().filter(|view| **view % 4 == 2).count();
    let (first, last) = trained.split_at(before_the_last);
    assert!(first.len() >= 2 * 80 && last.len() >= 80, "{} {}", first.len(), last.len());
    assert_eq!(judges(first), 0);
    assert!(judges(last) > 0, "{last:?}");
    assert!((0..10).filter(|view| view % 4 != 2).all(|view| first.contains(&view)), "all others heal");
}

/// An object in each quarter of every photo, shown while the quarter is close to the photo.
struct Quarters {
    /// Largest mean absolute difference of a quarter, 0 to 1.
    limit: f32,
}

impl ObjectJudge for Quarters {
    fn shown(&self, view: u32, photo: &Pixels, picture: &[f32]) -> Result<Vec<bool>, String> {
        assert!(view % 4 == 2, "view {view} does not judge");
        let differs = |i: usize| (picture[i] - f32::from(photo.rgb[i]) / 255.0).abs();
        let of = |quarter: usize| (0..AREA).filter(move |i| i * 4 / AREA == quarter);
        Ok((0..4).map(|quarter| of(quarter).map(differs).sum::<f32>() * 4.0 / AREA as f32 <= self.limit).collect())
    }
}

#[test]
fn few_of_the_objects_may_be_lost() {
    /// So much that the objects hold pruning back.
    const TOLERANCE_DB: f64 = 15.0;
    let ground_truth = cloud(14, 100, 0.8);
    let photos = photos(&ground_truth);
    let model = with_faint_splats(&ground_truth);
    let judge = Quarters { limit: 0.04 };
    let prune = |share: Option<f64>| {
        let objects = share.map(|share| ObjectTolerance { judge: &judge, share });
        with_job(&model, None, &photos, &|_| true, |job| {
            within_tolerance(job, &Pruning::within(TOLERANCE_DB), objects.as_ref(), &mut |_| Flow::Continue).unwrap()
        })
    };
    let [(free, unjudged), (some, half), (few, none), (all, any)] = [None, Some(0.5), Some(0.0), Some(1.0)].map(prune);
    println!(
        "{} splats: {} {} {} {}; {half:?} {none:?} {any:?}",
        model.len(),
        free.len(),
        some.len(),
        few.len(),
        all.len()
    );
    assert!(free == all && unjudged.objects.is_none(), "a tolerance of all objects changes nothing");
    let [before, after] = none.objects.unwrap();
    assert!(before >= 4 && after == before, "{none:?}");
    let [_, after] = half.objects.unwrap();
    assert!(2 * after >= before, "{half:?}");
    assert!(2 * any.objects.unwrap()[1] < before, "{any:?}");
    assert!(free.len() < some.len() && some.len() < few.len() && few.len() < model.len());

    struct Fails;
    impl ObjectJudge for Fails {
        fn shown(&self, _: u32, _: &Pixels, _: &[f32]) -> Result<Vec<bool>, String> {
            Err("no network".into())
        }
    }
    let objects = ObjectTolerance { judge: &Fails, share: 0.0 };
    let failed = with_job(&model, None, &photos, &|_| true, |job| {
        within_tolerance(job, &Pruning::within(0.1), Some(&objects), &mut |_| Flow::Continue).unwrap_err()
    });
    assert_eq!(failed, TrainError::Objects("no network".into()));
}
