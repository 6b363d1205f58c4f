//! A store's URL: which kind of place it names, and how that is reached.

use std::error::Error;
use std::path::Path as FilePath;
use std::sync::Arc;
use std::time::Duration;

use object_store::aws::{AmazonS3Builder, AmazonS3ConfigKey};
use object_store::client::SpawnedReqwestConnector;
use object_store::local::LocalFileSystem;
use object_store::memory::InMemory;
use object_store::path::Path;
use object_store::prefix::PrefixStore;
use object_store::{BackoffConfig, ClientConfigKey, ObjectStore, RetryConfig};
use scene::BadInput;
use tokio::runtime::{Builder, Handle, Runtime};

use crate::{StoreError, error};

const ADVICE: &str = "give the path of a folder, file:///path, s3://bucket/prefix or memory://";
/// The longest time that one object may take to come or go, unless AWS_TIMEOUT says another.
const REQUEST_TIMEOUT: &str = "300 seconds";
/// A request that fails in a way that may pass is not tried again after this long.
const RETRY_TIMEOUT: Duration = Duration::from_secs(60);

/// Where objects lie, and what carries them there if that is a network.
pub(crate) struct Place {
    pub(crate) objects: Arc<dyn ObjectStore>,
    pub(crate) network: Option<Arc<Network>>,
}

/// What comes from outside, beside the URL.
pub(crate) struct Surroundings<V> {
    /// The environment; what is called `AWS_…` there says how S3 is reached.
    pub(crate) variables: V,
    /// How often a request that fails in a way that may pass is tried again.
    pub(crate) retries: usize,
}

/// Opens what the URL names.
pub(crate) fn open(
    url: &str,
    surroundings: Surroundings<impl Iterator<Item = (String, String)>>,
) -> Result<Place, StoreError> {
    let here = |objects: Arc<dyn ObjectStore>| Place { objects, network: None };
    match url.split_once("://") {
        None if url.is_empty() => Err(BadInput::new("the store", "has an empty URL", ADVICE).into()),
        None => Ok(here(Arc::new(folder(url, FilePath::new(url))?))),
        Some(("memory", "")) => Ok(here(Arc::new(InMemory::new()))),
        Some(("file", _)) => {
            let path = url::Url::parse(url).ok().and_then(|url| url.to_file_path().ok());
            let path = path.ok_or_else(|| BadInput::new(url, "is not the URL of a local folder", ADVICE))?;
            Ok(here(Arc::new(folder(url, &path)?)))
        }
        Some(("s3", rest)) => bucket(url, rest, surroundings),
        Some((scheme, _)) => {
            let problem = format!("stores of the kind {scheme}:// are not supported by this version");
            Err(BadInput::new(url, problem, ADVICE).into())
        }
    }
}

fn folder(url: &str, path: &FilePath) -> Result<LocalFileSystem, StoreError> {
    let closed = |error: &(dyn Error + 'static)| StoreError::Closed { store: url.into(), reason: error::reason(error) };
    std::fs::create_dir_all(path).map_err(|error| closed(&error))?;
    LocalFileSystem::new_with_prefix(path).map_err(|error| closed(&error))
}

/// `rest` is what follows `s3://`: a bucket, and after a slash the prefix of all objects.
fn bucket(
    url: &str,
    rest: &str,
    surroundings: Surroundings<impl Iterator<Item = (String, String)>>,
) -> Result<Place, StoreError> {
    const SHAPE: &str = "give it as s3://bucket or s3://bucket/prefix, of ASCII letters, digits and ._-";
    let (bucket, prefix) = rest.split_once('/').unwrap_or((rest, ""));
    if bucket.contains('@') || bucket.contains(':') {
        let advice = "give the server by AWS_ENDPOINT_URL, the keys by AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY";
        // Not repeated here: what stands before an @ may be a secret.
        return Err(BadInput::new("the store's URL", "names a key or a server beside the bucket", advice).into());
    }
    let plain = |part: &str| {
        !part.is_empty()
            && !part.starts_with('.')
            && part.bytes().all(|b| b.is_ascii_alphanumeric() || matches!(b, b'.' | b'_' | b'-'))
    };
    let parts: Vec<&str> = prefix.trim_end_matches('/').split('/').filter(|_| !prefix.is_empty()).collect();
    if !plain(bucket) || !parts.iter().all(|part| plain(part)) {
        return Err(BadInput::new(url, "is not the URL of a bucket", SHAPE).into());
    }

    let mut builder = AmazonS3Builder::new().with_config(client(ClientConfigKey::Timeout), REQUEST_TIMEOUT);
    for (name, value) in surroundings.variables.filter(|(name, _)| name.starts_with("AWS_")) {
        // Those that are none of the store's business (AWS_PROFILE, say) are left alone.
        if let Ok(key) = name.to_ascii_lowercase().parse::<AmazonS3ConfigKey>() {
            builder = builder.with_config(key, value);
        }
    }
    check_reach(url, &builder)?;
    let (network, handle) = Network::start(url)?;
    let allowed = allows_http(&builder);
    let local = endpoint_of(&builder).is_some_and(|endpoint| is_loopback(&endpoint));
    let retry = RetryConfig {
        backoff: BackoffConfig::default(),
        max_retries: surroundings.retries,
        retry_timeout: RETRY_TIMEOUT,
    };
    let s3 = builder
        .with_bucket_name(bucket)
        .with_allow_http(allowed || local)
        .with_retry(retry)
        .with_http_connector(SpawnedReqwestConnector::new(handle))
        .build()
        .map_err(|error| BadInput::new(url, format!("cannot be reached: {}", error::reason(&error)), CHECK))?;
    let objects: Arc<dyn ObjectStore> = if parts.is_empty() {
        Arc::new(s3)
    } else {
        Arc::new(PrefixStore::new(s3, Path::from_iter(parts.iter().copied())))
    };
    Ok(Place { objects, network: Some(Arc::new(network)) })
}

const CHECK: &str = "check the AWS_ variables of the environment";

/// What would otherwise be found out only by the first request, some in minutes.
fn check_reach(url: &str, builder: &AmazonS3Builder) -> Result<(), BadInput> {
    use AmazonS3ConfigKey as Key;
    let given = |key: Key| builder.get_config_value(&key).is_some_and(|value| !value.is_empty());
    if given(Key::AccessKeyId) != given(Key::SecretAccessKey) {
        let advice = "set both AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY, or neither";
        return Err(BadInput::new(url, "has half of its keys", advice));
    }
    let Some(endpoint) = endpoint_of(builder) else { return Ok(()) };
    // Without keys the machine's own are asked for, which only Amazon's have.
    let others = [Key::WebIdentityTokenFile, Key::ContainerCredentialsRelativeUri, Key::ContainerCredentialsFullUri];
    let unsigned = builder.get_config_value(&Key::SkipSignature).is_some_and(|value| is_true(&value));
    if !given(Key::AccessKeyId) && !unsigned && !others.into_iter().any(given) {
        let advice = "set AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY, or AWS_SKIP_SIGNATURE=true for a public bucket";
        return Err(BadInput::new(url, "has an endpoint and no keys", advice));
    }
    let known = url::Url::parse(&endpoint).ok().filter(|url| matches!(url.scheme(), "http" | "https"));
    let known = known.filter(|url| url.has_host());
    let Some(parsed) = known else {
        return Err(BadInput::new("AWS_ENDPOINT_URL", "is not an http:// or https:// URL", "give https://host:port"));
    };
    if parsed.scheme() == "http" && !is_loopback(&endpoint) && !allows_http(builder) {
        let advice = "give an https:// one, or set AWS_ALLOW_HTTP=true where the network itself is trusted";
        return Err(BadInput::new("AWS_ENDPOINT_URL", "is on another machine and not encrypted", advice));
    }
    Ok(())
}

fn endpoint_of(builder: &AmazonS3Builder) -> Option<String> {
    let value = |key| builder.get_config_value(&key).filter(|value| !value.is_empty());
    value(AmazonS3ConfigKey::S3Endpoint).or_else(|| value(AmazonS3ConfigKey::Endpoint))
}

fn client(key: ClientConfigKey) -> AmazonS3ConfigKey {
    AmazonS3ConfigKey::Client(key)
}

fn allows_http(builder: &AmazonS3Builder) -> bool {
    builder.get_config_value(&client(ClientConfigKey::AllowHttp)).is_some_and(|value| is_true(&value))
}

fn is_true(value: &str) -> bool {
    matches!(&*value.to_ascii_lowercase(), "1" | "true" | "on" | "yes" | "y")
}

fn is_loopback(endpoint: &str) -> bool {
    match url::Url::parse(endpoint).ok().as_ref().and_then(url::Url::host) {
        Some(url::Host::Domain(name)) => name == "localhost",
        Some(url::Host::Ipv4(address)) => address.is_loopback(),
        Some(url::Host::Ipv6(address)) => address.is_loopback(),
        None => false,
    }
}

/// A runtime of the store's own: connections live as long as the store does, whichever runtime or thread asks.
#[derive(Debug)]
pub(crate) struct Network(Option<Runtime>);

impl Network {
    fn start(url: &str) -> Result<(Self, Handle), StoreError> {
        // The one library of cryptography; that it is set already is as good.
        let _ = rustls::crypto::ring::default_provider().install_default();
        let runtime = Builder::new_multi_thread().worker_threads(1).thread_name("plat-store").enable_all().build();
        let runtime = runtime.map_err(|error| StoreError::Closed { store: url.into(), reason: error.to_string() })?;
        let handle = runtime.handle().clone();
        Ok((Self(Some(runtime)), handle))
    }

    /// Where what must not be async is carried out.
    pub(crate) fn handle(&self) -> Option<&Handle> {
        self.0.as_ref().map(Runtime::handle)
    }
}

impl Drop for Network {
    fn drop(&mut self) {
        // The last clone of a store may go on a thread that must not wait.
        if let Some(runtime) = self.0.take() {
            runtime.shutdown_background();
        }
    }
}
