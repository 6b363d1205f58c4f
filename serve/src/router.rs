//! The paths of the server, as docs/src/dashboard.md lists them.

use std::path::PathBuf;
use std::sync::Arc;

use axum::body::Body;
use axum::extract::rejection::JsonRejection;
use axum::extract::{DefaultBodyLimit, Path, Query, Request, State};
use axum::http::header::{CACHE_CONTROL, CONTENT_TYPE, ETAG, IF_NONE_MATCH};
use axum::http::{Extensions, HeaderMap, HeaderValue, Method, StatusCode, Uri, Version, header};
use axum::response::{IntoResponse, Response};
use axum::routing::{get, post};
use axum::{Json, Router, middleware};
use scene::{ArtefactId, BlockId};
use serde::{Deserialize, Serialize};
use serde_json::json;
use tower_http::compression::CompressionLayer;
use tower_http::cors::{Any, CorsLayer};
use tower_http::services::{ServeDir, ServeFile};
use tower_http::set_header::SetResponseHeaderLayer;

use crate::access::{Access, guard};
use crate::block_files::{BlockFiles, Format, Wanted};
use crate::feed::Feed;
use crate::follow::Find;
use crate::project::Project;
use crate::refused::{Refused, refusal};
use crate::{assets, control, results, static_files, status_page};

/// Bytes of a request's body.
const BODY_LIMIT: usize = 1 << 20;
/// Events of one page.
const EVENTS_PAGE: usize = 1000;
/// What never changes under its name may be kept for a year.
const IMMUTABLE: &str = "private, max-age=31536000, immutable";
/// Scripts and pictures come from this server only; Spark compiles WebAssembly, and runs workers from blobs.
const POLICY: &str = "default-src 'self'; script-src 'self' 'wasm-unsafe-eval' blob:; worker-src 'self' blob:; \
    connect-src 'self' data: blob:; img-src 'self' data: blob:; style-src 'self' 'unsafe-inline'; frame-ancestors 'none'";

/// What requests are answered from.
#[derive(Clone)]
pub(crate) struct App(Arc<Shared>);

struct Shared {
    feed: Arc<Feed>,
    /// `None` where nothing can be controlled.
    find: Option<Find>,
    block_files: BlockFiles,
    files: Option<PathBuf>,
    results: Option<PathBuf>,
}

impl App {
    /// `files` are served under `/files/`, `results` are shown.
    pub(crate) fn new(
        feed: Arc<Feed>,
        find: Option<Find>,
        (files, results): (Option<PathBuf>, Option<PathBuf>),
    ) -> std::io::Result<Self> {
        Ok(Self(Arc::new(Shared { feed, find, block_files: BlockFiles::new()?, files, results })))
    }

    fn project(&self, job: u64) -> Result<Arc<Project>, Refused> {
        let board = self.0.feed.board();
        let job = board.jobs.get(&job).ok_or_else(|| no_job(job))?;
        Ok(job.project.clone())
    }
}

/// All paths.
pub(crate) fn router(app: App, access: Access, cors: bool) -> Router {
    let files = app.0.files.clone();
    let mut router = Router::new()
        .route("/api/events", get(events))
        .route("/api/snapshot", get(snapshot))
        .route("/api/jobs/{job}/plan", get(plan))
        .route("/api/jobs/{job}/tasks", get(tasks))
        .route("/api/jobs/{job}/tasks/{task}", get(task))
        .route("/api/jobs/{job}/log", get(log))
        .route("/api/jobs/{job}/curve", get(curve))
        .route("/api/jobs/{job}/views", get(views))
        .route("/api/jobs/{job}/photos/{file}", get(photo))
        .route("/api/jobs/{job}/model", get(model))
        .route("/api/jobs/{job}/blocks/{file}", get(block))
        .route("/api/jobs/{job}/{file}", get(backdrop))
        .route("/api/jobs/{job}/control", post(control_job).layer(DefaultBodyLimit::max(BODY_LIMIT)))
        .route("/api/results", get(all_results))
        .route("/api/downloads", get(downloads))
        .route("/status", get(status))
        .route("/healthz", get(async || "ok\n"))
        .fallback(asset)
        .with_state(app);
    if let Some(files) = files {
        router = router.nest_service("/files", ServeDir::new(files).precompressed_br().precompressed_gzip());
    }
    if cors {
        let methods = [Method::GET, Method::HEAD];
        let exposed = [header::ACCEPT_RANGES, header::CONTENT_LENGTH, header::CONTENT_RANGE, ETAG];
        router = router.layer(
            CorsLayer::new()
                .allow_origin(Any)
                .allow_methods(methods)
                .allow_headers([header::RANGE])
                .expose_headers(exposed),
        );
    }
    let set = |name: &'static str, value: &'static str| {
        SetResponseHeaderLayer::if_not_present(header::HeaderName::from_static(name), HeaderValue::from_static(value))
    };
    router
        // JSON alone: the pages are compressed already, splats and photos by their formats, and events must not wait.
        .layer(CompressionLayer::new().compress_when(is_json))
        .layer(middleware::from_fn_with_state(access, guard))
        .layer(set("x-content-type-options", "nosniff"))
        .layer(set("referrer-policy", "no-referrer"))
        .layer(set("content-security-policy", POLICY))
}

fn is_json(_: StatusCode, _: Version, headers: &HeaderMap, _: &Extensions) -> bool {
    headers.get(CONTENT_TYPE).is_some_and(|kind| kind == "application/json")
}

fn no_job(job: u64) -> Refused {
    refusal(StatusCode::NOT_FOUND, format!("there is no job {job}"))
}

fn nothing(what: &str) -> Refused {
    refusal(StatusCode::NOT_FOUND, what)
}

fn failed(problem: &str) -> Refused {
    tracing::warn!("{problem}");
    refusal(StatusCode::INTERNAL_SERVER_ERROR, problem)
}

fn json_of(value: &impl Serialize) -> Response {
    Json(value).into_response()
}

fn json_text(text: Vec<u8>) -> Response {
    ([(CONTENT_TYPE, "application/json")], text).into_response()
}

#[derive(Deserialize)]
struct After {
    after: Option<u64>,
    task: Option<u32>,
}

async fn events(State(App(app)): State<App>, Query(query): Query<After>, headers: HeaderMap) -> Response {
    let last = headers.get("last-event-id").and_then(|id| id.to_str().ok()).and_then(|id| id.parse().ok());
    let Some(stream) = app.feed.stream(last.or(query.after)) else {
        return refusal(StatusCode::SERVICE_UNAVAILABLE, "too many browsers follow this server; close some")
            .into_response();
    };
    // Proxies shall pass each event on at once.
    let about = [("content-type", "text/event-stream"), ("cache-control", "no-store"), ("x-accel-buffering", "no")];
    (about, Body::from_stream(stream)).into_response()
}

async fn snapshot(State(App(app)): State<App>) -> Response {
    json_text(app.feed.snapshot())
}

async fn plan(State(app): State<App>, Path(job): Path<u64>, headers: HeaderMap) -> Result<Response, Refused> {
    let project = app.project(job)?;
    let tag = format!("\"{}\"", project.plan_id);
    let seen = headers.get(IF_NONE_MATCH).is_some_and(|seen| seen.as_bytes() == tag.as_bytes());
    let about = [(ETAG, tag), (CACHE_CONTROL, "no-cache".into())];
    if seen {
        return Ok((StatusCode::NOT_MODIFIED, about).into_response());
    }
    let text = tokio::task::spawn_blocking(move || project.plan_json().to_vec()).await.unwrap_or_default();
    Ok((about, json_text(text)).into_response())
}

async fn tasks(State(App(app)): State<App>, Path(job): Path<u64>) -> Result<Response, Refused> {
    let view = app.feed.read(|board, seq| board.jobs.get(&job).map(|job| job.tasks_view(seq)));
    view.map(|view| json_of(&view)).ok_or_else(|| no_job(job))
}

async fn task(State(App(app)): State<App>, Path((job, task)): Path<(u64, u32)>) -> Result<Response, Refused> {
    let board = app.feed.board();
    let of = board.jobs.get(&job).ok_or_else(|| no_job(job))?;
    let view = of.task_view(task).ok_or_else(|| nothing(&format!("job {job} has no task {task}")))?;
    Ok(json_of(&view))
}

async fn log(State(App(app)): State<App>, Path(job): Path<u64>, Query(query): Query<After>) -> Response {
    let lines = app.feed.board().events(job, query.task, query.after.unwrap_or(0), EVENTS_PAGE);
    json_of(&json!({"lines": lines}))
}

async fn curve(State(App(app)): State<App>, Path(job): Path<u64>) -> Result<Response, Refused> {
    let curve = app.feed.board().jobs.get(&job).map(|job| job.quality.clone());
    curve.map(|curve| json_of(&curve)).ok_or_else(|| no_job(job))
}

async fn views(State(app): State<App>, Path(job): Path<u64>) -> Result<Response, Refused> {
    let project = app.project(job)?;
    let views = tokio::task::spawn_blocking(move || project.views()).await;
    Ok(json_of(&views.unwrap_or_default()))
}

async fn photo(State(app): State<App>, Path((job, file)): Path<(u64, String)>) -> Result<Response, Refused> {
    let view = file.strip_suffix(".jpg").and_then(|view| view.parse::<u32>().ok());
    let view = view.ok_or_else(|| nothing("photos are photos/VIEW.jpg"))?;
    let project = app.project(job)?;
    match tokio::task::spawn_blocking(move || project.photo(view)).await {
        Ok(Ok(Some(bytes))) => {
            Ok(([(CONTENT_TYPE, "image/jpeg"), (CACHE_CONTROL, "private, max-age=3600")], bytes).into_response())
        }
        Ok(Ok(None)) => Err(nothing("this server has no photo of that view")),
        Ok(Err(problem)) => Err(failed(&problem)),
        Err(error) => Err(failed(&error.to_string())),
    }
}

async fn model(State(App(app)): State<App>, Path(job): Path<u64>) -> Result<Response, Refused> {
    let found = app.feed.read(|board, seq| {
        let job = board.jobs.get(&job)?;
        let done: Vec<_> = (0..job.project.blocks() as u32).map(|task| job.finished(task)).collect();
        Some((job.project.clone(), done, seq))
    });
    let (project, done, seq) = found.ok_or_else(|| no_job(job))?;
    let view = move || project.model_view(seq, |task| done.get(task as usize).cloned().flatten());
    Ok(json_of(&tokio::task::spawn_blocking(view).await.unwrap_or_default()))
}

async fn block(
    State(app): State<App>,
    Path((job, file)): Path<(u64, String)>,
    request: Request,
) -> Result<Response, Refused> {
    let unknown = || nothing("blocks are blocks/ARTEFACT.rad and blocks/ARTEFACT.spz");
    let (name, extension) = file.rsplit_once('.').ok_or_else(unknown)?;
    let (artefact, format) =
        (name.parse::<ArtefactId>().map_err(|_| unknown())?, Format::of(extension).ok_or_else(unknown)?);
    let project = app.project(job)?;
    // Only results of finished blocks: the store has other objects.
    let task = app.0.feed.board().jobs.get(&job).and_then(|job| job.task_of_artefact(&artefact.0));
    let block = task.and_then(|task| project.about(task).block);
    let block = block.ok_or_else(|| nothing(&format!("no finished block of job {job} has the result {artefact}")))?;
    file_of(&app, &project, Wanted { block, artefact, backdrop: false, format }, request).await
}

async fn backdrop(
    State(app): State<App>,
    Path((job, file)): Path<(u64, String)>,
    request: Request,
) -> Result<Response, Refused> {
    let unknown = || nothing("there is no such path; docs/src/dashboard.md lists them");
    let format = file.strip_prefix("backdrop.").and_then(Format::of).ok_or_else(unknown)?;
    let project = app.project(job)?;
    let root = project.task_of(BlockId::ROOT);
    let finished = root.and_then(|root| app.0.feed.board().jobs.get(&job)?.artefact_of(root));
    let Some(artefact) = finished else { return Ok(StatusCode::NO_CONTENT.into_response()) };
    file_of(&app, &project, Wanted { block: BlockId::ROOT, artefact, backdrop: true, format }, request).await
}

/// Answers with a block's file, or the range of it that was asked for.
async fn file_of(app: &App, project: &Arc<Project>, wanted: Wanted, request: Request) -> Result<Response, Refused> {
    let path = app.0.block_files.path(project, wanted).await.map_err(|problem| failed(&problem))?;
    // A model without a backdrop is no fault.
    let Some(path) = path else { return Ok(StatusCode::NO_CONTENT.into_response()) };
    let served = ServeFile::new(path).try_call(request).await.map_err(|error| failed(&error.to_string()))?;
    let mut response = served.map(Body::new);
    response.headers_mut().insert(CACHE_CONTROL, HeaderValue::from_static(IMMUTABLE));
    Ok(response)
}

async fn control_job(
    State(App(app)): State<App>,
    Path(job): Path<u64>,
    request: Result<Json<control::Request>, JsonRejection>,
) -> Result<Response, Refused> {
    let Json(request) = request.map_err(|error| refusal(StatusCode::BAD_REQUEST, error.body_text()))?;
    let is_running = app.feed.board().server.controls;
    let Some(find) = app.find.as_ref().filter(|_| is_running) else {
        return Err(refusal(StatusCode::CONFLICT, "this server shows a finished job; nothing can be changed"));
    };
    match control::carry_out(find, job, request).await {
        Ok(()) => Ok(json_of(&json!({}))),
        Err((true, problem)) => Err(refusal(StatusCode::CONFLICT, problem)),
        Err((false, problem)) => Err(refusal(StatusCode::BAD_GATEWAY, problem)),
    }
}

async fn all_results(State(App(app)): State<App>) -> Response {
    let own = results::own(&app.feed.board(), app.feed.now());
    let folder = app.results.clone();
    let all = tokio::task::spawn_blocking(move || results::results(folder.as_deref(), own)).await;
    json_of(&all.unwrap_or_default())
}

async fn downloads(State(App(app)): State<App>) -> Response {
    let Some(files) = app.files.clone() else { return json_of(&json!({"files": []})) };
    let listed = tokio::task::spawn_blocking(move || static_files::downloads(&files)).await;
    json_of(&listed.unwrap_or_default())
}

async fn status(State(App(app)): State<App>) -> Response {
    let now = app.feed.now();
    let page = status_page::page(&app.feed.board(), now);
    ([(CONTENT_TYPE, "text/html; charset=utf-8"), (CACHE_CONTROL, "no-store")], page).into_response()
}

/// The dashboard's own files. Without them, as when they were not built, the status page.
async fn asset(State(app): State<App>, method: Method, uri: Uri, headers: HeaderMap) -> Response {
    if method != Method::GET && method != Method::HEAD {
        return refusal(StatusCode::METHOD_NOT_ALLOWED, "only GET").into_response();
    }
    let path = uri.path().trim_start_matches('/');
    let path = if path.is_empty() { "index.html" } else { path };
    match assets::answer(path, &headers) {
        Some(response) => response,
        None if path == "index.html" => status(State(app)).await,
        None => nothing("there is no such path; docs/src/dashboard.md lists them").into_response(),
    }
}
