use super::*;

fn stores() -> (tempfile::TempDir, Vec<BlockingStore>) {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a new folder");
    let url = url::Url::from_directory_path(folder.path().join("with file url")).unwrap();
    let open = |url: &str| Store::open(url).unwrap().blocking();
    (folder, vec![open("memory://"), open(path.to_str().unwrap()), open(url.as_str())])
}

fn artefact_file(root: &FilePath, id: ArtefactId) -> std::path::PathBuf {
    root.join(artefact_path(id).as_ref())
}

#[test]
fn what_is_put_is_got_whole_and_in_ranges() {
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
fn traffic_is_counted_apart() {
    let all = Store::open("memory://").unwrap();
    let (one, other) = (all.metered(), all.metered());
    let id = one.blocking().put("the survey map").unwrap();
    one.blocking().put("the survey map").unwrap();
    other.blocking().get(id).unwrap();
    other.blocking().get_ranges(id, &[11..14, 4..10]).unwrap();
    assert!(other.blocking().get(ArtefactId::of(b"never put")).is_err());
    other.blocking().put_name("a/b", "12345").unwrap();
    other.blocking().get_name("a/b").unwrap();
    assert_eq!(one.traffic(), Traffic { read: 0, written: 14 });
    assert_eq!(other.clone().traffic(), Traffic { read: 14 + 9 + 5, written: 5 });
    assert_eq!(all.traffic(), Traffic::default());
}

#[test]
fn names_are_replaced_and_confined() {
    let (_folder, stores) = stores();
    for store in &stores {
        assert_eq!(store.get_name("ingest/ab").unwrap(), None);
        store.put_name("ingest/ab", "one").unwrap();
        store.put_name("ingest/ab", "two").unwrap();
        assert_eq!(store.get_name("ingest/ab").unwrap().unwrap(), "two");
        let long = "x".repeat(NAME_LIMIT + 1);
        for bad in ["", "/etc", "a//b", "../a", "a/..", "a\\b", "a b", ".hidden", "ä", &long] {
            assert!(matches!(store.put_name(bad, "x"), Err(StoreError::BadName(_))), "{bad}");
            assert!(matches!(store.get_name(bad), Err(StoreError::BadName(_))), "{bad}");
        }
    }
}

#[test]
fn damage_is_named_and_a_cut_artefact_is_mended_by_the_next_put() {
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
fn a_place_that_refuses_writes_gives_one_line() {
    let folder = tempfile::tempdir().unwrap();
    let store = Store::open(folder.path().to_str().unwrap()).unwrap().blocking();
    std::fs::write(folder.path().join("artefacts"), "a file where the folder should be").unwrap();
    let line = store.put("some bytes").unwrap_err().to_string();
    assert!(line.starts_with("cannot write artefacts/") && line.lines().count() == 1, "{line}");
}

#[test]
fn other_urls_are_refused() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("file");
    std::fs::write(&file, "x").unwrap();
    for bad in ["", "s3://bucket/key", "gs://b", "az://b", "file://relative/path", "memory://x", file.to_str().unwrap()]
    {
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
