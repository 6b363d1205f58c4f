//! Opens a store's URL: a local folder, memory, or an S3 bucket configured by the environment.

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

use crate::error::{self, StoreError};
use crate::paths::is_plain_segment;

const ADVICE: &str = "give the path of a folder, file:///path, s3://bucket/prefix or memory://";
/// Timeout of one request, unless AWS_TIMEOUT gives another.
const REQUEST_TIMEOUT: &str = "300 seconds";
/// A request that fails with a transient error is not retried after this long.
const RETRY_TIMEOUT: Duration = Duration::from_secs(60);

/// An opened object store, with its runtime if it is remote.
pub(crate) struct Location {
    pub(crate) objects: Arc<dyn ObjectStore>,
    pub(crate) network: Option<Arc<Network>>,
}

/// Configuration beside the URL.
pub(crate) struct Environment<V> {
    /// Environment variables; those named `AWS_…` configure S3.
    pub(crate) variables: V,
    /// Retries of a request that fails with a transient error.
    pub(crate) retries: usize,
}

/// Opens the object store that the URL names.
pub(crate) fn open(
    url: &str,
    environment: Environment<impl Iterator<Item = (String, String)>>,
) -> Result<Location, StoreError> {
    let local = |objects: Arc<dyn ObjectStore>| Location { objects, network: None };
    match url.split_once("://") {
        None if url.is_empty() => Err(BadInput::new("the store", "has an empty URL", ADVICE).into()),
        None => Ok(local(Arc::new(folder(url, FilePath::new(url))?))),
        Some(("memory", "")) => Ok(local(Arc::new(InMemory::new()))),
        Some(("file", _)) => {
            let path = url::Url::parse(url).ok().and_then(|url| url.to_file_path().ok());
            let path = path.ok_or_else(|| BadInput::new(url, "is not the URL of a local folder", ADVICE))?;
            Ok(local(Arc::new(folder(url, &path)?)))
        }
        Some(("s3", rest)) => bucket(url, rest, environment),
        Some((scheme, _)) => {
            let problem = format!("stores of the kind {scheme}:// are not supported by this version");
            Err(BadInput::new(url, problem, ADVICE).into())
        }
    }
}

fn folder(url: &str, path: &FilePath) -> Result<LocalFileSystem, StoreError> {
    let cannot_open =
        |error: &(dyn Error + 'static)| StoreError::CannotOpen { store: url.into(), reason: error::reason(error) };
    std::fs::create_dir_all(path).map_err(|error| cannot_open(&error))?;
    LocalFileSystem::new_with_prefix(path).map_err(|error| cannot_open(&error))
}

/// Opens an S3 bucket. `rest` is the URL after `s3://`: `bucket` or `bucket/prefix`.
fn bucket(
    url: &str,
    rest: &str,
    environment: Environment<impl Iterator<Item = (String, String)>>,
) -> Result<Location, StoreError> {
    const SHAPE: &str = "give it as s3://bucket or s3://bucket/prefix, of ASCII letters, digits and ._-";
    let (bucket, prefix) = rest.split_once('/').unwrap_or((rest, ""));
    if bucket.contains('@') || bucket.contains(':') {
        let advice = "give the server by AWS_ENDPOINT_URL, the keys by AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY";
        // The message omits the URL: the text before an @ may be a secret.
        return Err(BadInput::new("the store's URL", "names a key or a server beside the bucket", advice).into());
    }
    let parts: Vec<&str> = prefix.trim_end_matches('/').split('/').filter(|_| !prefix.is_empty()).collect();
    if !is_plain_segment(bucket) || !parts.iter().all(|part| is_plain_segment(part)) {
        return Err(BadInput::new(url, "is not the URL of a bucket", SHAPE).into());
    }

    let mut builder = AmazonS3Builder::new().with_config(client(ClientConfigKey::Timeout), REQUEST_TIMEOUT);
    for (name, value) in environment.variables.filter(|(name, _)| name.starts_with("AWS_")) {
        // Other AWS_ variables, such as AWS_PROFILE, do not configure the store.
        if let Ok(key) = name.to_ascii_lowercase().parse::<AmazonS3ConfigKey>() {
            builder = builder.with_config(key, value);
        }
    }
    check_config(url, &builder)?;
    let (network, handle) = Network::start(url)?;
    let allowed = allows_http(&builder);
    let local = endpoint_of(&builder).is_some_and(|endpoint| is_loopback(&endpoint));
    let retry = RetryConfig {
        backoff: BackoffConfig::default(),
        max_retries: environment.retries,
        retry_timeout: RETRY_TIMEOUT,
    };
    let s3 = builder
        .with_bucket_name(bucket)
        .with_allow_http(allowed || local)
        .with_retry(retry)
        .with_http_connector(SpawnedReqwestConnector::new(handle))
        .build()
        .map_err(|error| {
            BadInput::new(url, format!("cannot be reached: {}", error::reason(&error)), CHECK_VARIABLES)
        })?;
    let objects: Arc<dyn ObjectStore> = if parts.is_empty() {
        Arc::new(s3)
    } else {
        Arc::new(PrefixStore::new(s3, Path::from_iter(parts.iter().copied())))
    };
    Ok(Location { objects, network: Some(Arc::new(network)) })
}

const CHECK_VARIABLES: &str = "check the AWS_ variables of the environment";

/// Refuses a configuration that only the first request would otherwise find wrong, at worst after minutes of retries.
fn check_config(url: &str, builder: &AmazonS3Builder) -> Result<(), BadInput> {
    use AmazonS3ConfigKey as Key;
    let is_set = |key: Key| builder.get_config_value(&key).is_some_and(|value| !value.is_empty());
    if is_set(Key::AccessKeyId) != is_set(Key::SecretAccessKey) {
        let advice = "set both AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY, or neither";
        return Err(BadInput::new(url, "has half of its keys", advice));
    }
    let Some(endpoint) = endpoint_of(builder) else { return Ok(()) };
    // Without keys the client would query the EC2 metadata service, which exists on Amazon's machines only.
    let others = [Key::WebIdentityTokenFile, Key::ContainerCredentialsRelativeUri, Key::ContainerCredentialsFullUri];
    let unsigned = builder.get_config_value(&Key::SkipSignature).is_some_and(|value| is_true(&value));
    if !is_set(Key::AccessKeyId) && !unsigned && !others.into_iter().any(is_set) {
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

/// The runtime of a remote store's connections, which outlive the runtimes and threads of callers.
#[derive(Debug)]
pub(crate) struct Network(Option<Runtime>);

impl Network {
    fn start(url: &str) -> Result<(Self, Handle), StoreError> {
        // Fails if the process has installed a provider already, which serves as well.
        let _ = rustls::crypto::ring::default_provider().install_default();
        let runtime = Builder::new_multi_thread().worker_threads(1).thread_name("plat-store").enable_all().build();
        let runtime =
            runtime.map_err(|error| StoreError::CannotOpen { store: url.into(), reason: error.to_string() })?;
        let handle = runtime.handle().clone();
        Ok((Self(Some(runtime)), handle))
    }

    /// A handle to spawn requests on.
    pub(crate) fn handle(&self) -> Option<&Handle> {
        self.0.as_ref().map(Runtime::handle)
    }
}

impl Drop for Network {
    fn drop(&mut self) {
        // The last clone of a store may be dropped on an async thread, which must not block.
        if let Some(runtime) = self.0.take() {
            runtime.shutdown_background();
        }
    }
}
