//! The dashboard over a live coordinator: what it shows of a job, what it may change, and that strangers' requests end in refusals while
//! the job goes on.

mod common;

use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Duration;

use blocks::{DetectTask, Plan, ViewUse};
use proto::{Access, Client, KeyPair, Token};
use rcgen::{CertificateParams, KeyPair as Key};
use scene::frame::encode_splats;
use scene::{ArtefactId, Rect, Splat, Splats};
use serde_json::Value;
use serve::{Kind, Options, Serving, Source};
use store::Store;
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::{TcpListener, TcpStream};
use tokio_util::sync::CancellationToken;

use common::{lease, plan_of, task};

const TOKEN: &str = "a-token-of-enough-characters";

/// A coordinator with a job of a root and four blocks, and its dashboard.
struct Setup {
    store: Store,
    client: Client,
    serving: Serving,
    address: SocketAddr,
    _files: tempfile::TempDir,
    _stop: tokio_util::sync::DropGuard,
}

fn options(files: &tempfile::TempDir) -> Options {
    let files = Some(files.path().to_path_buf());
    let began = std::time::Instant::now();
    let clock = Arc::new(move || 1_800_000_000_000 + began.elapsed().as_millis() as u64);
    Options { identity: None, token: None, files, results: None, cors: false, clock }
}

async fn setup() -> Setup {
    let blocks = ["0/0/0", "1/0/0", "1/1/1", "1/1/0", "1/0/1"];
    setup_of(plan_of(1, blocks.map(|block| task(block, &[])).to_vec())).await
}

async fn setup_of(plan: Plan) -> Setup {
    let folder = tempfile::tempdir().unwrap();
    let store = Store::open(&folder.path().join("store").display().to_string()).unwrap();
    std::fs::write(folder.path().join("notes.txt"), "0123456789").unwrap();
    let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
    let url = format!("http://{}", listener.local_addr().unwrap());
    let stop = CancellationToken::new();
    let hosting = coordinator::Options::new(store.clone());
    tokio::spawn(coordinator::serve(listener, hosting, stop.clone().cancelled_owned()));
    let mut client = proto::connect(&url, &Access::default()).unwrap();
    let plan = store.put(plan.to_frame().into()).await.unwrap();
    let request = proto::SubmitRequest { plan: plan.0.to_vec(), store_url: store.url().into() };
    client.submit(request).await.unwrap();

    let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
    let address = listener.local_addr().unwrap();
    let found = (client.clone(), url);
    let find: serve::Find = Arc::new(move || {
        let found = Ok(found.clone());
        Box::pin(async { found })
    });
    let source = Source::Coordinator { find, name: Some("town".into()), kind: Kind::Coordinator };
    let serving = serve::serve(listener, options(&folder), source).await.unwrap();
    Setup { store, client, serving, address, _files: folder, _stop: stop.drop_guard() }
}

/// Sends a request's text and returns status, headers and body of the answer.
async fn ask(address: SocketAddr, request: &str) -> (u16, String, Vec<u8>) {
    let mut stream = TcpStream::connect(address).await.unwrap();
    let mut answer = Vec::new();
    // The server may answer and close while a hostile request is still being written: the answer is what counts.
    let _ = stream.write_all(request.as_bytes()).await;
    let _ = stream.read_to_end(&mut answer).await;
    let end = answer.windows(4).position(|at| at == b"\r\n\r\n").map_or(answer.len(), |at| at + 4);
    let head = String::from_utf8_lossy(&answer[..end]).to_lowercase();
    let status = head.split(' ').nth(1).and_then(|status| status.parse().ok()).unwrap_or(0);
    (status, head, answer[end..].to_vec())
}

async fn get(address: SocketAddr, path: &str, headers: &str) -> (u16, String, Vec<u8>) {
    ask(address, &format!("GET {path} HTTP/1.1\r\nhost: localhost\r\nconnection: close\r\n{headers}\r\n")).await
}

async fn json(address: SocketAddr, path: &str) -> Value {
    // Chunked bodies do not occur: every JSON answer has its length.
    let (status, head, body) = get(address, path, "").await;
    assert!(status == 200 && !head.contains("chunked"), "{path}: {head}");
    serde_json::from_slice(&body).unwrap()
}

/// Asks until the answer is as wanted.
async fn until(address: SocketAddr, path: &str, is_there: impl Fn(&Value) -> bool) -> Value {
    for _ in 0..600 {
        let (status, _, body) = get(address, path, "").await;
        if let Some(value) = serde_json::from_slice(&body).ok().filter(|value| status == 200 && is_there(value)) {
            return value;
        }
        tokio::time::sleep(Duration::from_millis(50)).await;
    }
    panic!("{path} never was as wanted: {:?}", String::from_utf8_lossy(&get(address, path, "").await.2));
}

/// A worker that finishes the next task, with two splats: one in the core of 1/0/0, one of 1/1/1.
async fn finish_one(setup: &mut Setup) -> String {
    let attempt = lease(&mut setup.client, "w").await;
    let report = proto::Report { step: 1, steps: 2, loss: Some(0.5), splats: 2, ..Default::default() };
    let request = proto::ReportRequest { attempt: Some(attempt), reports: vec![report] };
    setup.client.report(request).await.unwrap();
    let mut splats = Splats::new(0);
    for at in [25.0, 75.0] {
        splats.push(&Splat::round(glam::Vec3::new(at, at, 1.0), -1.0, glam::Vec3::splat(0.5), 0.9));
    }
    let artefact = setup.store.put(encode_splats(&splats).into()).await.unwrap();
    let request = proto::CompleteRequest { attempt: Some(attempt), artefact: artefact.0.to_vec(), then: None };
    assert!(setup.client.complete(request).await.unwrap().into_inner().accepted);
    artefact.to_string()
}

#[tokio::test(flavor = "multi_thread")]
async fn a_job_is_shown_as_it_runs_and_can_be_controlled() {
    let mut setup = setup().await;
    let at = setup.address;
    let job = until(at, "/api/snapshot", |all| all["jobs"][0]["id"] == 1).await["jobs"][0].clone();
    assert_eq!((&job["name"], &job["blocks"], &job["counts"]["ready"]), (&"town".into(), &5.into(), &1.into()));
    assert_eq!((&job["state"], &job["model"]), (&"running".into(), &false.into()));
    let artefact = finish_one(&mut setup).await;
    let tasks =
        until(at, "/api/jobs/1/tasks", |tasks| tasks["state"].as_str().is_some_and(|all| all.starts_with('d'))).await;
    assert_eq!(
        (&tasks["state"], &tasks["splats"][0], &tasks["progress"][0]),
        (&"drrrr".into(), &2.into(), &1000.into())
    );
    let root = until(at, "/api/jobs/1/tasks/0", |task| task["attempts"][0]["end"] == "done").await;
    assert_eq!((&root["block"], &root["attempts"][0]["worker"]), (&"0/0/0".into(), &"w".into()));
    assert_eq!((&root["curve"]["step"], &root["curve"]["loss"]), (&serde_json::json!([1]), &serde_json::json!([0.5])));
    let workers = until(at, "/api/snapshot", |all| all["workers"][0]["done"] == 1).await["workers"].clone();
    assert_eq!((&workers[0]["name"], &workers[0]["state"]), (&"w".into(), &"idle".into()));

    // The finished block's core as a file, local to the centre, and a range of it.
    let model = json(at, "/api/jobs/1/model").await;
    assert_eq!(
        (&model["blocks"][0]["artefact"], &model["centre"]),
        (&artefact.clone().into(), &serde_json::json!([50.0, 50.0, 0.0]))
    );
    assert_eq!(model["blocks"][1]["origin"], serde_json::json!([-25.0, -25.0, 0.0]));
    assert!(model["blocks"][1]["artefact"].is_null());
    let path = format!("/api/jobs/1/blocks/{artefact}.spz");
    let (status, head, whole) = get(at, &path, "").await;
    assert!(status == 200 && head.contains("immutable") && head.contains("etag: "), "{head}");
    let (splats, _) = scene::spz::read(&whole).unwrap();
    assert!(splats.len() == 2 && (splats.mean(0) - glam::Vec3::new(-25.0, -25.0, 1.0)).length() < 1e-3);
    let rad = scene::rad::read(&get(at, &format!("/api/jobs/1/blocks/{artefact}.rad"), "").await.2).unwrap();
    assert_eq!(rad.leaves().len(), 2);
    // JSON is compressed for browsers that read that, the splats' own compression is left alone.
    for (path, is_compressed) in [("/api/jobs/1/model", true), (path.as_str(), false)] {
        let (_, head, _) = get(at, path, "accept-encoding: gzip\r\n").await;
        assert_eq!(head.contains("content-encoding: gzip"), is_compressed, "{path}: {head}");
    }
    let (status, head, part) = get(at, &path, "range: bytes=2-5\r\n").await;
    assert!(status == 206 && part == whole[2..6] && head.contains(&format!("bytes 2-5/{}", whole.len())), "{head}");
    assert_eq!(get(at, &path, "range: bytes=99999999-\r\n").await.0, 416);

    // The stream: a snapshot with a number, then what changes.
    let mut stream = TcpStream::connect(at).await.unwrap();
    stream.write_all(b"GET /api/events HTTP/1.1\r\nhost: localhost\r\n\r\n").await.unwrap();
    let body = serde_json::json!({"what": "pause"}).to_string();
    let post = |body: &str, more: &str| {
        let length = body.len();
        format!(
            "POST /api/jobs/1/control HTTP/1.1\r\nhost: localhost\r\nconnection: close\r\ncontent-length: {length}\r\n{more}\r\n{body}"
        )
    };
    let kind = "content-type: application/json\r\n";
    assert_eq!(ask(at, &post(&body, kind)).await.0, 200);
    let mut text = String::new();
    while !text.contains("\"state\":\"paused\"") {
        let mut bytes = [0; 4096];
        let count = stream.read(&mut bytes).await.unwrap();
        assert!(count > 0, "{text}");
        text += &String::from_utf8_lossy(&bytes[..count]);
    }
    assert!(text.contains("event: snapshot") && text.contains("event: delta"), "{text}");
    for (body, more, status) in [
        (body.as_str(), "content-type: text/plain\r\n", 415),
        ("{\"what\":\"explode\"}", kind, 400),
        ("{\"what\":\"retry\",\"tasks\":[]}", kind, 409),
        ("{\"what\":\"retry\",\"tasks\":[0]}", kind, 409),
        ("{\"what\":\"priority\",\"priority\":300}", kind, 409),
    ] {
        let (got, _, answer) = ask(at, &post(body, more)).await;
        let answer: Value = serde_json::from_slice(&answer).unwrap();
        assert!(got == status && answer["error"].is_string(), "{body}: {got} {answer}");
    }
    let (status, _, page) = get(at, "/status", "").await;
    let page = String::from_utf8(page).unwrap();
    assert!(status == 200 && page.contains("town") && page.contains("1 of 5 done"), "{page}");
    drop(setup.serving);
    while TcpStream::connect(at).await.is_ok() {
        tokio::time::sleep(Duration::from_millis(20)).await;
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn a_job_looks_for_objects_before_it_trains() {
    let detect = |first| DetectTask { first, count: 2, work_millis: 1, memory_bytes: 1 };
    let used = |view| ViewUse { view, mip: 0, window: Rect { x: 0, y: 0, width: 1, height: 1 } };
    let mut plan = plan_of(0, vec![task("0/0/0", &[])]);
    plan.tasks[0].views = vec![used(0), used(3)];
    plan.settings.zone_weight = 1.0;
    (plan.detector, plan.detect_tasks) = (Some(ArtefactId([2; 32])), vec![detect(0), detect(2)]);
    let mut setup = setup_of(plan).await;
    let at = setup.address;
    let job = until(at, "/api/snapshot", |all| all["jobs"][0]["counts"]["ready"] == 2).await["jobs"][0].clone();
    assert_eq!((&job["phase"], &job["blocks"], &job["detections"]), (&"detect".into(), &1.into(), &2.into()));
    assert_eq!((&job["photos_done"], &job["photos_all"], &job["counts"]["ready"]), (&0.into(), &4.into(), &2.into()));
    assert_eq!(json(at, "/api/jobs/1/plan").await["detections"], 2);
    let task = json(at, "/api/jobs/1/tasks/1").await;
    assert_eq!((&task["kind"], &task["block"], &task["steps"]), (&"detect".into(), &Value::Null, &2.into()));
    finish_one(&mut setup).await;
    let job = until(at, "/api/snapshot", |all| all["jobs"][0]["counts"]["done"] == 1).await["jobs"][0].clone();
    assert_eq!((&job["phase"], &job["photos_done"], &job["model"]), (&"detect".into(), &2.into(), &false.into()));
    finish_one(&mut setup).await;
    until(at, "/api/jobs/1/tasks", |tasks| tasks["state"] == "rdd").await;
    lease(&mut setup.client, "w").await;
    let job = until(at, "/api/snapshot", |all| all["jobs"][0]["counts"]["leased"] == 1).await["jobs"][0].clone();
    assert_eq!((&job["phase"], &job["photos_done"]), (&"train".into(), &4.into()));
    let (status, _, page) = get(at, "/status", "").await;
    assert!(status == 200 && String::from_utf8(page).unwrap().contains("2 of 3 done"));
}

#[tokio::test(flavor = "multi_thread")]
async fn a_job_that_failed_runs_again_when_it_is_retried() {
    let mut setup = setup().await;
    let at = setup.address;
    let attempt = lease(&mut setup.client, "w").await;
    let kind = proto::FailureKind::Input.into();
    let request = proto::FailRequest { attempt: Some(attempt), message: "the photo is torn".into(), kind };
    assert!(setup.client.fail(request).await.unwrap().into_inner().accepted);
    until(at, "/api/snapshot", |all| all["jobs"][0]["state"] == "incomplete").await;
    let task = until(at, "/api/jobs/1/tasks/0", |task| task["attempts"][0]["end"] == "failed").await;
    assert!(task["state"] == "f" && task["attempts"][0]["reason"].as_str().unwrap().contains("the photo is torn"));
    let body = r#"{"what":"retry","tasks":[0]}"#;
    let request = format!(
        "POST /api/jobs/1/control HTTP/1.1\r\nhost: localhost\r\nconnection: close\r\ncontent-type: application/json\r\ncontent-length: {}\r\n\r\n{body}",
        body.len()
    );
    assert_eq!(ask(at, &request).await.0, 200);
    until(at, "/api/snapshot", |all| all["jobs"][0]["state"] == "running").await;
    for _ in 0..5 {
        finish_one(&mut setup).await;
    }
    let all = until(at, "/api/snapshot", |all| all["jobs"][0]["state"] == "done").await;
    assert_eq!(all["jobs"][0]["counts"]["done"], 5);
}

#[tokio::test(flavor = "multi_thread")]
async fn a_folder_is_shown_while_it_is_written_and_afterwards() {
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("town");
    let store = Store::open("memory://").unwrap();
    let serve_it = async || {
        let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
        let address = listener.local_addr().unwrap();
        let serving = serve::serve(listener, options(&folder), Source::Folders(vec![out.clone()])).await;
        serving.map(|serving| (serving, address))
    };
    std::fs::create_dir(&out).unwrap();
    let error = serve_it().await.map(|_| ()).unwrap_err().to_string();
    assert!(error.contains("plan.json") && error.contains("plat train"), "{error}");

    // As `plat train` writes it: the plan, lines of metrics, at last the model.
    let plan = plan_of(1, ["0/0/0", "1/0/0", "1/1/1", "1/1/0", "1/0/1"].map(|block| task(block, &[])).to_vec());
    model::save_json(&out.join("plan.json"), &plan).unwrap();
    let (_serving, at) = serve_it().await.unwrap();
    let job = json(at, "/api/snapshot").await["jobs"][0].clone();
    assert_eq!((&job["name"], &job["state"], &job["model"]), (&"town".into(), &"running".into(), &false.into()));
    let line = r#"{"task":"0/0/0","attempt":1,"step":5,"steps":10,"cpu_seconds":1.5,"wall_seconds":1.0,"splats":7,"loss":0.25,"psnr":null,"merged_splats":null}"#;
    std::fs::write(out.join("metrics.jsonl"), format!("{line}\n{{\"torn\":")).unwrap();
    let tasks = until(at, "/api/jobs/1/tasks", |tasks| tasks["progress"][0] == 500).await;
    assert_eq!((&tasks["state"], &tasks["splats"][0]), (&"lwwww".into(), &7.into()));

    let mut splats = Splats::new(0);
    splats.push(&Splat::round(glam::Vec3::new(25.0, 25.0, 1.0), -1.0, glam::Vec3::splat(0.5), 0.9));
    let artefact = store.put(encode_splats(&splats).into()).await.unwrap();
    let written = tokio::task::spawn_blocking(move || {
        let capture = scene::Capture::default();
        model::write(&out, &plan, &[artefact; 5], &store.blocking(), &capture, 1).map(|_| ()).unwrap();
    });
    written.await.unwrap();
    let job = until(at, "/api/snapshot", |all| all["jobs"][0]["state"] == "done").await["jobs"][0].clone();
    assert_eq!((&job["counts"]["done"], &job["model"]), (&5.into(), &true.into()));
    let path = format!("/api/jobs/1/blocks/{artefact}.spz");
    assert_eq!(get(at, &path, "").await.0, 200);
    let refused = "POST /api/jobs/1/control HTTP/1.1\r\nhost: localhost\r\nconnection: close\r\ncontent-type: application/json\r\ncontent-length: 16\r\n\r\n{\"what\":\"pause\"}";
    assert_eq!(ask(at, refused).await.0, 409);
    assert!(
        json(at, "/api/downloads").await["files"]
            .as_array()
            .unwrap()
            .iter()
            .any(|file| file["path"] == "town/merged.ply")
    );

    // Two folders are two jobs. Figures of faces are those of `plat eval --seams`.
    let out = folder.path().join("town");
    let face = r#"{"a": {"level": 1, "x": 0, "y": 0}, "b": {"level": 1, "x": 1, "y": 0}, "views": 3, "jump": 4.5, "step": null}"#;
    std::fs::create_dir_all(out.join("eval")).unwrap();
    std::fs::write(out.join("eval/report.json"), format!(r#"{{"seams": {{"faces": [{face}]}}}}"#)).unwrap();
    let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
    let at = listener.local_addr().unwrap();
    let _serving = serve::serve(listener, options(&folder), Source::Folders(vec![out.clone(), out])).await.unwrap();
    let model = json(at, "/api/jobs/2/model").await;
    assert_eq!(model["faces"][0], serde_json::json!({"a": "1/0/0", "b": "1/1/0", "jump": 4.5, "step": null}));
}

#[tokio::test(flavor = "multi_thread")]
async fn hostile_requests_are_refused_while_the_job_goes_on() {
    let mut setup = setup().await;
    let at = setup.address;
    until(at, "/api/snapshot", |all| all["jobs"][0]["id"] == 1).await;
    assert_eq!(get(at, "/files/notes.txt", "range: bytes=3-4\r\n").await.2, b"34");
    let other = "0".repeat(64);
    for (path, status) in [
        ("/files/../../../etc/passwd", 404),
        ("/files/%2e%2e/%2e%2e/%2e%2e/etc/passwd", 404),
        ("/files//etc/passwd", 404),
        ("/files/..%2f..%2fetc%2fpasswd", 404),
        ("/assets/../../Cargo.toml", 404),
        ("/api/jobs/1/blocks/../../../../etc/passwd", 404),
        // An object of the store that is no result of the job.
        (&format!("/api/jobs/1/blocks/{other}.spz"), 404),
        ("/api/jobs/1/blocks/x.spz", 404),
        ("/api/jobs/1/photos/0.jpg", 404),
        ("/api/jobs/1/photos/99999999999999999999.jpg", 404),
        ("/api/jobs/9/plan", 404),
        ("/api/jobs/x/plan", 400),
        ("/api/jobs/1/tasks/4294967295", 404),
        ("/api/jobs/1/log?after=-1", 400),
    ] {
        let (got, _, body) = get(at, path, "").await;
        assert!(got == status && !String::from_utf8_lossy(&body).contains("root:"), "{path}: {got}");
    }
    // Ranges: far too large, thousands of them, reversed.
    let many: Vec<String> = (0..2000).map(|i| format!("{i}-{i}")).collect();
    for range in ["0-18446744073709551615", "5-2", &many.join(",")] {
        let (got, _, body) = get(at, "/files/notes.txt", &format!("range: bytes={range}\r\n")).await;
        assert!([200, 206, 416, 431].contains(&got) && body.len() <= 200, "{got}");
    }
    // Headers and bodies without end, and other methods.
    let flood = format!("GET / HTTP/1.1\r\nhost: localhost\r\nx: {}\r\n\r\n", "y".repeat(1 << 20));
    assert!([0, 400, 431].contains(&ask(at, &flood).await.0));
    let body = "z".repeat(2 << 20);
    let post = format!(
        "POST /api/jobs/1/control HTTP/1.1\r\nhost: localhost\r\ncontent-type: application/json\r\nconnection: close\r\ncontent-length: {}\r\n\r\n{body}",
        body.len()
    );
    assert!([0, 400, 413].contains(&ask(at, &post).await.0));
    for method in ["PUT", "DELETE"] {
        let request = format!(
            "{method} /files/notes.txt HTTP/1.1\r\nhost: localhost\r\nconnection: close\r\ncontent-type: application/json\r\n\r\n"
        );
        assert_eq!(ask(at, &request).await.0, 405);
    }
    // A page of another site that let its name point here.
    assert_eq!(ask(at, "GET /api/snapshot HTTP/1.1\r\nhost: evil.example\r\nconnection: close\r\n\r\n").await.0, 403);

    // A thousand silent connections and as many streams as there may be; others are refused, and the job goes on.
    let mut held = Vec::new();
    for _ in 0..1000 {
        held.push(TcpStream::connect(at).await.unwrap());
    }
    let mut refused = 0;
    for _ in 0..300 {
        let mut stream = TcpStream::connect(at).await.unwrap();
        stream.write_all(b"GET /api/events HTTP/1.1\r\nhost: localhost\r\n\r\n").await.unwrap();
        let mut start = [0; 16];
        stream.read_exact(&mut start).await.unwrap();
        refused += usize::from(start.starts_with(b"HTTP/1.1 503"));
        held.push(stream);
    }
    assert!(refused >= 44, "{refused}");
    finish_one(&mut setup).await;
    until(at, "/api/snapshot", |all| all["jobs"][0]["counts"]["done"] == 1).await;
}

#[tokio::test(flavor = "multi_thread")]
async fn beyond_the_loopback_tls_and_a_token_are_needed() {
    let folder = tempfile::tempdir().unwrap();
    std::fs::write(folder.path().join("notes.txt"), "0123456789").unwrap();
    let (key, params) = (Key::generate().unwrap(), CertificateParams::new(vec!["localhost".into()]).unwrap());
    let certificate = params.self_signed(&key).unwrap().pem();
    let pair = KeyPair { certificate: certificate.clone().into(), key: key.serialize_pem().into() };
    let listen = async || TcpListener::bind("0.0.0.0:0").await.unwrap();
    let token = Token::new(TOKEN).unwrap();
    let (plain, named) = (options(&folder), Options { token: Some(token.clone()), ..options(&folder) });
    for refused in [plain, named] {
        let error = serve::serve(listen().await, refused, Source::Files).await.map(|_| ()).unwrap_err();
        assert!(error.to_string().contains("--token-file"), "{error}");
    }
    let options = Options { identity: Some(pair), token: Some(token), ..options(&folder) };
    let listener = listen().await;
    let port = listener.local_addr().unwrap().port();
    let serving = serve::serve(listener, options, Source::Files).await.unwrap();
    assert_eq!(serving.url, format!("https://localhost:{port}/"));
    // A provider of another test may be there already.
    let _ = rustls::crypto::ring::default_provider().install_default();
    let root = reqwest::Certificate::from_pem(certificate.as_bytes()).unwrap();
    let client = reqwest::Client::builder().tls_certs_only([root]).build().unwrap();
    let get = async |path: &str, password: Option<&str>| {
        let request = client.get(format!("{}{path}", serving.url));
        let request = if password.is_some() { request.basic_auth("anyone", password) } else { request };
        request.send().await.unwrap()
    };
    assert_eq!(get("healthz", None).await.status(), 200);
    for path in ["", "status", "api/snapshot", "files/notes.txt", "api/events"] {
        let answer = get(path, None).await;
        assert!(answer.status() == 401 && answer.headers().contains_key("www-authenticate"), "{path}");
        assert_eq!(get(path, Some("another-token-of-characters")).await.status(), 401);
    }
    let answer = get("files/notes.txt", Some(TOKEN)).await;
    assert_eq!(answer.text().await.unwrap(), "0123456789");
    // Without TLS nothing is answered.
    assert_ne!(ask(([127, 0, 0, 1], port).into(), "GET / HTTP/1.1\r\nhost: localhost\r\n\r\n").await.0, 200);
}
