use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use futures::StreamExt;
use futures::future::join_all;
use object_store::memory::InMemory;
use object_store::path::Path;
use object_store::{ObjectStore, PutMode};
use scene::ArtefactId;

use super::*;
use crate::doctor::examine;
use crate::open::Environment;
use crate::paths::artefact_path;

fn stores() -> (tempfile::TempDir, Vec<BlockingStore>) {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a new folder");
    let url = url::Url::from_directory_path(folder.path().join("with file url")).unwrap();
    let open = |url: &str| Store::open(url).unwrap().blocking();
    (folder, vec![open("memory://"), open(path.to_str().unwrap()), open(url.as_str())])
}

fn artefact_file(root: &std::path::Path, id: ArtefactId) -> std::path::PathBuf {
    root.join(artefact_path(id).as_ref())
}

#[test]
fn an_artefact_is_read_whole_and_in_ranges() {
    let (_folder, stores) = stores();
    for store in &stores {
        let id = store.put("the survey map").unwrap();
        assert_eq!(id, ArtefactId::of(b"the survey map"));
        assert_eq!(store.put("the survey map").unwrap(), id);
        assert_eq!(store.get(id).unwrap(), "the survey map");
        assert_eq!(store.get_ranges(id, &[11..14, 4..10]).unwrap(), ["map", "survey"]);
        assert!(store.get_ranges(id, std::slice::from_ref(&(10..15))).is_err());
        assert!(store.exists(id).unwrap() && store.size(id).unwrap() == Some(14));
        let other = ArtefactId::of(b"never put");
        assert!(!store.exists(other).unwrap());
        assert!(matches!(store.get(other), Err(StoreError::Missing { id, .. }) if id == other));
        assert!(matches!(store.get_ranges(other, std::slice::from_ref(&(0..1))), Err(StoreError::Missing { .. })));
    }
}

#[test]
fn a_damaged_artefact_is_discarded_and_can_be_put_again() {
    let folder = tempfile::tempdir().unwrap();
    let store = Store::open(folder.path().to_str().unwrap()).unwrap().blocking();
    let id = store.put("the survey map").unwrap();
    assert_eq!(store.get_or_discard(id).unwrap().unwrap(), "the survey map");
    std::fs::write(artefact_file(folder.path(), id), "the survey cap").unwrap();
    // Put keeps an object of the right length.
    assert_eq!(store.put("the survey map").unwrap(), id);
    assert!(matches!(store.get(id), Err(StoreError::Corrupt { .. })));
    assert_eq!(store.get_or_discard(id).unwrap(), None);
    assert_eq!(store.get_or_discard(id).unwrap(), None);
    assert!(!store.exists(id).unwrap());
    store.put("the survey map").unwrap();
    assert_eq!(store.get(id).unwrap(), "the survey map");
}

#[test]
fn metered_stores_count_their_own_traffic() {
    let all = Store::open("memory://").unwrap();
    let (one, other) = (all.metered(), all.metered());
    let id = one.blocking().put("the survey map").unwrap();
    one.blocking().put("the survey map").unwrap();
    other.blocking().get(id).unwrap();
    other.blocking().get_ranges(id, &[11..14, 4..10]).unwrap();
    assert!(other.blocking().get(ArtefactId::of(b"never put")).is_err());
    other.blocking().put_record("a/b", "12345").unwrap();
    other.blocking().get_record("a/b").unwrap();
    assert_eq!(one.traffic(), Traffic { read: 0, written: 14 });
    // The byte between the ranges is read with them.
    assert_eq!(other.clone().traffic(), Traffic { read: 14 + 10 + 5, written: 5 });
    assert_eq!(all.traffic(), Traffic::default());
    // A large gap between ranges is not read.
    let far = other.blocking().put(vec![7; 10_000]).unwrap();
    let before = other.traffic().read;
    assert_eq!(other.blocking().get_ranges(far, &[9000..9100, 0..50]).unwrap(), [vec![7; 100], vec![7; 50]]);
    assert_eq!(other.traffic().read, before + 150);
}

#[test]
fn records_are_replaced_and_their_names_confined() {
    let (_folder, stores) = stores();
    for store in &stores {
        assert_eq!(store.get_record("ingest/ab").unwrap(), None);
        store.put_record("ingest/ab", "one").unwrap();
        store.put_record("ingest/ab", "two").unwrap();
        assert_eq!(store.get_record("ingest/ab").unwrap().unwrap(), "two");
        let long = "x".repeat(MAX_RECORD_NAME_BYTES + 1);
        for bad in ["", "/etc", "a//b", "../a", "a/..", "a\\b", "a b", ".hidden", "ä", &long] {
            assert!(matches!(store.put_record(bad, "x"), Err(StoreError::BadRecordName(_))), "{bad}");
            assert!(matches!(store.get_record(bad), Err(StoreError::BadRecordName(_))), "{bad}");
        }
    }
}

#[test]
fn damage_is_reported_and_a_truncated_artefact_is_repaired_by_the_next_put() {
    let folder = tempfile::tempdir().unwrap();
    let store = Store::open(folder.path().to_str().unwrap()).unwrap().blocking();
    let id = store.put("some bytes").unwrap();
    let file = artefact_file(folder.path(), id);
    std::fs::write(&file, "some bytez").unwrap();
    let error = store.get(id).unwrap_err();
    assert!(matches!(error, StoreError::Corrupt { .. }) && error.to_string().contains(&id.to_string()));
    std::fs::write(&file, "some").unwrap();
    assert!(store.get_ranges(id, std::slice::from_ref(&(2..8))).is_err());
    store.put("some bytes").unwrap();
    assert_eq!(store.get(id).unwrap(), "some bytes");
}

#[test]
fn a_second_put_does_not_write() {
    let folder = tempfile::tempdir().unwrap();
    let store = Store::open(folder.path().to_str().unwrap()).unwrap().blocking();
    let id = store.put("some bytes").unwrap();
    let modified = || std::fs::metadata(artefact_file(folder.path(), id)).unwrap().modified().unwrap();
    let before = modified();
    store.put("some bytes").unwrap();
    assert_eq!(modified(), before);
}

#[test]
fn a_refused_write_is_a_one_line_error() {
    let folder = tempfile::tempdir().unwrap();
    let store = Store::open(folder.path().to_str().unwrap()).unwrap().blocking();
    std::fs::write(folder.path().join("artefacts"), "a file where the folder should be").unwrap();
    let line = store.put("some bytes").unwrap_err().to_string();
    assert!(line.starts_with("cannot write artefacts/") && line.lines().count() == 1, "{line}");
}

#[test]
fn invalid_urls_are_refused() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("file");
    std::fs::write(&file, "x").unwrap();
    for bad in ["", "gs://b", "az://b", "file://relative/path", "memory://x", file.to_str().unwrap()] {
        let line = Store::open(bad).unwrap_err().to_string();
        assert_eq!(line.lines().count(), 1, "{line}");
    }
}

#[tokio::test]
async fn the_blocking_store_works_on_a_runtime_thread_too() {
    let folder = tempfile::tempdir().unwrap();
    let store = Store::open(folder.path().to_str().unwrap()).unwrap();
    let id = store.blocking().put("some bytes").unwrap();
    assert_eq!(store.get(id).await.unwrap(), "some bytes");
}

#[test]
fn bucket_urls_and_aws_variables_are_checked() {
    let vars = |vars: &[(&str, &str)]| -> Vec<(String, String)> {
        vars.iter().map(|(name, value)| ((*name).to_owned(), (*value).to_owned())).collect()
    };
    let open = |url: &str, of: &[(&str, &str)]| {
        Store::open_with(url, Environment { variables: vars(of).into_iter(), retries: 0 })
    };
    let keys = [("AWS_ACCESS_KEY_ID", "k"), ("AWS_SECRET_ACCESS_KEY", "s3cret")];
    let at = |endpoint: &'static str| [keys[0], keys[1], ("AWS_ENDPOINT_URL", endpoint)];
    for url in ["s3://bucket", "s3://bucket/", "s3://my.bucket-1/a/b_c", "s3://bucket/prefix/"] {
        assert_eq!(open(url, &keys).unwrap().url(), url);
        // No request is sent yet.
        assert!(open(url, &at("http://127.0.0.1:1")).is_ok() && open(url, &at("https://far.example:9000")).is_ok());
    }
    for url in
        ["s3://", "s3:///key", "s3://bucket//key", "s3://bucket/../other", "s3://b?x", "s3://b/k e y", "s3://b/#"]
    {
        assert!(matches!(open(url, &keys), Err(StoreError::BadUrl(_))), "{url}");
    }
    let line = |url: &str, of: &[(&str, &str)]| open(url, of).unwrap_err().to_string();
    let secret = line("s3://key:s3cret@server/bucket", &keys);
    assert!(secret.contains("AWS_SECRET_ACCESS_KEY") && !secret.contains("s3cret"), "{secret}");
    assert!(line("s3://b", &keys[..1]).contains("half of its keys"));
    assert!(line("s3://b", &at("http://far.example:9000")).contains("AWS_ALLOW_HTTP=true"));
    assert!(line("s3://b", &at("far.example")).starts_with("AWS_ENDPOINT_URL"));
    assert!(line("s3://b", &[("AWS_ENDPOINT_URL", "http://127.0.0.1:1")]).contains("no keys"));
    let trusted = [keys[0], keys[1], ("AWS_ENDPOINT_URL", "http://far.example:9000"), ("AWS_ALLOW_HTTP", "true")];
    assert!(open("s3://b", &trusted).is_ok());
    let public = [("AWS_ENDPOINT_URL", "http://127.0.0.1:1"), ("AWS_SKIP_SIGNATURE", "true"), ("AWS_PROFILE", "me")];
    assert!(open("s3://b", &public).is_ok());
}

#[tokio::test(flavor = "multi_thread")]
async fn an_unreachable_server_is_a_one_line_error_on_any_thread() {
    let port = std::net::TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap().port();
    let vars = [
        ("AWS_ACCESS_KEY_ID", "k".to_owned()),
        ("AWS_SECRET_ACCESS_KEY", "s".to_owned()),
        ("AWS_ENDPOINT_URL", format!("http://127.0.0.1:{port}")),
        ("AWS_TIMEOUT", "2 seconds".to_owned()),
    ];
    let variables = vars.into_iter().map(|(name, value)| (name.to_owned(), value));
    let store = Store::open_with("s3://bucket/prefix", Environment { variables, retries: 0 }).unwrap();
    let line = store.get_record("a").await.unwrap_err().to_string();
    assert!(line.starts_with("cannot read names/a in the store s3://bucket/prefix: "), "{line}");
    let blocking = store.blocking();
    assert!(blocking.get_record("a").is_err());
    let elsewhere = blocking.clone();
    assert!(std::thread::spawn(move || elsewhere.get_record("a")).join().unwrap().is_err());
}

#[tokio::test(flavor = "multi_thread")]
async fn of_concurrent_creates_exactly_one_succeeds() {
    let folder = tempfile::tempdir().unwrap();
    for store in [Store::open("memory://").unwrap(), Store::open(folder.path().to_str().unwrap()).unwrap()] {
        for round in 0..10 {
            let name = format!("leader/{round:06}.json");
            let tries = (0..16).map(|writer: u8| store.create_record(&name, vec![writer].into()));
            let won: Vec<bool> = join_all(tries).await.into_iter().map(Result::unwrap).collect();
            let winner = won.iter().position(|won| *won).unwrap();
            assert_eq!(won.iter().filter(|won| **won).count(), 1);
            assert_eq!(store.newest_record("leader").await.unwrap().unwrap(), (round, vec![winner as u8].into()));
        }
        store.put_record("leader/newest.json", "no number".into()).await.unwrap();
        store.put_record("leaders/99.json", "elsewhere".into()).await.unwrap();
        assert_eq!(store.newest_record("leader").await.unwrap().unwrap().0, 9);
        store.remove_record("leader/000009.json").await.unwrap();
        store.remove_record("leader/000009.json").await.unwrap();
        assert_eq!(store.newest_record("leader").await.unwrap().unwrap().0, 8);
        assert_eq!(store.newest_record("nowhere").await.unwrap(), None);
        assert_eq!(store.record_names("leader").await.unwrap().len(), 10);
    }
}

#[tokio::test]
async fn an_artefact_can_be_removed_and_put_again() {
    let folder = tempfile::tempdir().unwrap();
    for store in [Store::open("memory://").unwrap(), Store::open(folder.path().to_str().unwrap()).unwrap()] {
        let id = store.put("some bytes".into()).await.unwrap();
        store.remove(id).await.unwrap();
        store.remove(id).await.unwrap();
        assert!(!store.exists(id).await.unwrap());
        assert_eq!(store.put("some bytes".into()).await.unwrap(), id);
        assert_eq!(store.get(id).await.unwrap(), "some bytes");
    }
}

/// A clock that advances by a millisecond on each read.
fn ticking() -> impl Fn() -> std::time::Duration {
    let read = AtomicU64::new(0);
    move || std::time::Duration::from_millis(read.fetch_add(1, Ordering::Relaxed))
}

#[tokio::test(flavor = "multi_thread")]
async fn the_doctor_passes_good_stores_and_leaves_nothing_behind() {
    let folder = tempfile::tempdir().unwrap();
    for store in [Store::open("memory://").unwrap(), Store::open(folder.path().to_str().unwrap()).unwrap()] {
        let found = examine(&store, "test", &ticking()).await.unwrap();
        assert!(found.is_fit() && found.races_held == crate::doctor::RACES, "{found:?}");
        assert_eq!(found.create.p99, std::time::Duration::from_millis(1));
        assert_eq!(found.read_bytes_per_second, 1000.0 * f64::from(16 << 20));
        let left = store.objects().list(None).count().await;
        assert_eq!((left, found.warnings.len()), (0, 0));
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn the_doctor_fails_stores_without_exclusive_create_or_consistent_listing() {
    use faulty::{Fault, Faulty};
    for (fault, words) in [
        (Fault::CreateReplaces, "succeeded instead of one: two coordinators"),
        (Fault::CreateUnknown, "an exclusive create"),
        (Fault::ListsNothing, "not listed"),
    ] {
        let objects = Arc::new(Faulty { inner: InMemory::new(), fault });
        let found = examine(&Store::over(objects, "faulty"), "test", &ticking()).await.unwrap();
        assert!(!found.is_fit() && found.faults.iter().any(|line| line.contains(words)), "{found:?}");
    }
}

/// Object stores with the faults of some real servers.
mod faulty {
    use futures::stream::BoxStream;
    use object_store::{
        CopyOptions, GetOptions, GetResult, ListResult, MultipartUpload, ObjectMeta, PutMultipartOptions, PutOptions,
        PutPayload, PutResult, Result,
    };

    use super::*;

    #[derive(Debug, Clone, Copy, PartialEq)]
    pub(super) enum Fault {
        CreateReplaces,
        CreateUnknown,
        ListsNothing,
    }

    #[derive(Debug)]
    pub(super) struct Faulty {
        pub(super) inner: InMemory,
        pub(super) fault: Fault,
    }

    impl std::fmt::Display for Faulty {
        fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
            f.write_str("faulty")
        }
    }

    #[async_trait::async_trait]
    impl ObjectStore for Faulty {
        async fn put_opts(&self, at: &Path, bytes: PutPayload, mut options: PutOptions) -> Result<PutResult> {
            match (self.fault, &options.mode) {
                (Fault::CreateReplaces, PutMode::Create) => options.mode = PutMode::Overwrite,
                (Fault::CreateUnknown, PutMode::Create) => {
                    let source = "501 Not Implemented".into();
                    return Err(object_store::Error::Generic { store: "faulty", source });
                }
                _ => {}
            }
            self.inner.put_opts(at, bytes, options).await
        }

        async fn put_multipart_opts(
            &self,
            at: &Path,
            options: PutMultipartOptions,
        ) -> Result<Box<dyn MultipartUpload>> {
            self.inner.put_multipart_opts(at, options).await
        }

        async fn get_opts(&self, at: &Path, options: GetOptions) -> Result<GetResult> {
            self.inner.get_opts(at, options).await
        }

        fn delete_stream(&self, at: BoxStream<'static, Result<Path>>) -> BoxStream<'static, Result<Path>> {
            self.inner.delete_stream(at)
        }

        fn list(&self, prefix: Option<&Path>) -> BoxStream<'static, Result<ObjectMeta>> {
            if self.fault == Fault::ListsNothing { futures::stream::empty().boxed() } else { self.inner.list(prefix) }
        }

        async fn list_with_delimiter(&self, prefix: Option<&Path>) -> Result<ListResult> {
            self.inner.list_with_delimiter(prefix).await
        }

        async fn copy_opts(&self, from: &Path, to: &Path, options: CopyOptions) -> Result<()> {
            self.inner.copy_opts(from, to, options).await
        }
    }
}
