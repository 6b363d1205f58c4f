//! The dashboard's built files, which are part of the program; `npm run build` in `dashboard/` makes them.

use axum::body::Body;
use axum::http::header::{ACCEPT_ENCODING, CACHE_CONTROL, CONTENT_ENCODING, CONTENT_TYPE, ETAG, IF_NONE_MATCH, VARY};
use axum::http::{HeaderMap, Response, StatusCode};
use rust_embed::{EmbeddedFile, RustEmbed};

#[derive(RustEmbed)]
#[folder = "../dashboard/dist/"]
#[allow_missing = true]
struct Built;

/// Compressed files beside the plain ones, the smallest first.
const ENCODINGS: [(&str, &str); 2] = [("br", "br"), ("gzip", "gz")];

/// The file of this path, in the smallest form that the browser reads; `None` if there is none.
pub(crate) fn answer(path: &str, headers: &HeaderMap) -> Option<Response<Body>> {
    let plain = Built::get(path)?;
    let accepted = headers.get(ACCEPT_ENCODING).and_then(|accepted| accepted.to_str().ok()).unwrap_or_default();
    let accepts =
        |name: &str| accepted.split(',').any(|item| item.split(';').next().is_some_and(|of| of.trim() == name));
    let mut candidates = ENCODINGS.iter().filter(|(name, _)| accepts(name));
    let compressed =
        candidates.find_map(|(name, extension)| Some((*name, Built::get(&format!("{path}.{extension}"))?)));
    let (encoding, file) = compressed.map_or((None, plain), |(name, file)| (Some(name), file));
    let tag = tag(&file);
    // Names of scripts and styles have the hash of their content in them; the page itself has not.
    let cache = if path.starts_with("assets/") { "public, max-age=31536000, immutable" } else { "no-cache" };
    let mut response = Response::builder()
        .header(CONTENT_TYPE, kind(path))
        .header(CACHE_CONTROL, cache)
        .header(ETAG, &tag)
        .header(VARY, "accept-encoding");
    if headers.get(IF_NONE_MATCH).is_some_and(|seen| seen.as_bytes() == tag.as_bytes()) {
        return response.status(StatusCode::NOT_MODIFIED).body(Body::empty()).ok();
    }
    if let Some(encoding) = encoding {
        response = response.header(CONTENT_ENCODING, encoding);
    }
    response.body(Body::from(file.data)).ok()
}

fn tag(file: &EmbeddedFile) -> String {
    let hash = file.metadata.sha256_hash();
    format!("\"{}\"", hash[..16].iter().map(|byte| format!("{byte:02x}")).collect::<String>())
}

fn kind(path: &str) -> &'static str {
    match path.rsplit_once('.').map_or("", |(_, extension)| extension) {
        "html" => "text/html; charset=utf-8",
        "js" => "text/javascript; charset=utf-8",
        "css" => "text/css; charset=utf-8",
        "svg" => "image/svg+xml",
        "json" => "application/json",
        "wasm" => "application/wasm",
        "png" => "image/png",
        _ => "application/octet-stream",
    }
}
