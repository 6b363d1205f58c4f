//! `plat serve`: shows jobs and models in a browser, and serves exported files, until it is stopped.

use std::path::{Path, PathBuf};

use proto::Access;
use scene::BadInput;
use serde::Serialize;
use serve::{Kind, Options, Source};
use store::Store;
use tokio_util::sync::CancellationToken;

use crate::args::ServeArgs;
use crate::dashboard::{listen, options};
use crate::failure::Failure;
use crate::output::Output;
use crate::remote::{finder, key_pair, pem, runtime, token};
use crate::signals::until_signalled;

#[derive(Serialize)]
struct Served {
    command: &'static str,
    url: String,
}

pub(crate) fn run(args: &ServeArgs, output: &Output) -> Result<(), Failure> {
    let (identity, token) = (key_pair(&args.tls_cert, &args.tls_key)?, token(&args.token_file)?);
    let authority = args.tls_ca.as_deref().map(|path| pem("--tls-ca", path, "CERTIFICATE")).transpose()?;
    let access = Access { authority, identity: identity.clone(), token: token.clone() };
    let results = Some(args.results.clone()).filter(|folder| folder.is_dir());
    let runtime = runtime()?;
    let url = runtime.block_on(async {
        let (source, files) = source(args, access).await?;
        let options = Options { identity, token, files, results, cors: args.cors, ..options() };
        let listener = listen("--listen", args.listen).await?;
        let mut serving = serve::serve(listener, options, source).await?;
        output.note(format!("dashboard at {}", serving.url));
        let stop = CancellationToken::new();
        let signals = tokio::spawn(until_signalled(stop.clone()));
        tokio::select! { () = stop.cancelled() => {}, () = serving.wait() => {} }
        signals.abort();
        Ok::<_, Failure>(serving.url.clone())
    })?;
    let text = format!("stopped serving {url}");
    output.result(&Served { command: "serve", url }, &text)
}

/// What to show, and the folder whose files are served.
async fn source(args: &ServeArgs, access: Access) -> Result<(Source, Option<PathBuf>), Failure> {
    let following = |url: &str, access: Access| -> Result<Source, Failure> {
        Ok(Source::Coordinator { find: finder(url, access)?, name: None, kind: Kind::Coordinator })
    };
    if let Some(url) = &args.coordinator {
        return Ok((following(url, access)?, None));
    }
    let folders: Vec<PathBuf> = args.paths.iter().map(PathBuf::from).collect();
    let is_model = |folder: &PathBuf| folder.join("model/model.json").is_file() || folder.join("plan.json").is_file();
    if folders.iter().all(is_model) {
        let newest = folders.last().cloned();
        return Ok((Source::Folders(folders), newest));
    }
    let [path] = &args.paths[..] else {
        let other =
            folders.iter().find(|folder| !is_model(folder)).map_or_else(String::new, |f| f.display().to_string());
        return Err(BadInput::new(other, "is no model of plat train", "give only such folders, or one path").into());
    };
    if path.contains("://") {
        return Ok((following(path, access)?, None));
    }
    let folder = PathBuf::from(path);
    if !folder.is_dir() {
        let advice = "give a folder that plat train wrote, one of exported files, or the store of a cluster";
        return Err(BadInput::new(path, "is not a folder", advice).into());
    }
    if is_cluster(&folder).await {
        let url = format!("file://{}", std::path::absolute(&folder).unwrap_or(folder).display());
        return Ok((following(&url, access)?, None));
    }
    Ok((Source::Files, Some(folder)))
}

/// Whether coordinators have led over this store.
async fn is_cluster(folder: &Path) -> bool {
    let Ok(store) = Store::open(&folder.display().to_string()) else { return false };
    matches!(store.newest_record(proto::leader::FOLDER).await, Ok(Some(_)))
}
