//! Authenticates calls: a client sends its protocol version and its token in the headers, and the server checks them.
//!
//! ```text
//! plat-wire: 2                       in every call
//! authorization: Bearer <token>      if the coordinator requires one
//! traceparent: 00-<trace>-<span>-01  if the caller is traced; optional, and not part of the authentication
//! ```

use std::error::Error;
use std::fmt;
use std::time::Duration;

use scene::{ArtefactId, BadInput};
use tonic::metadata::AsciiMetadataValue;
use tonic::service::Interceptor;
use tonic::service::interceptor::InterceptedService;
use tonic::transport::{Certificate, Channel, ClientTlsConfig, Endpoint, Identity};
use tonic::{Request, Status};

use crate::coordinator_client::CoordinatorClient;
use crate::{MESSAGE_BYTES_LIMIT, MIN_VERSION, VERSION};

/// The header with the caller's protocol version.
pub const VERSION_HEADER: &str = "plat-wire";
/// Time limit of connecting.
const CONNECT_TIMEOUT: Duration = Duration::from_secs(5);
/// Time limit of a call.
pub const CALL_TIMEOUT: Duration = Duration::from_secs(20);
/// Interval of either side's HTTP/2 keep-alive pings.
pub const KEEP_ALIVE: Duration = Duration::from_secs(15);
/// Without an answer to a ping for this long, the connection is closed.
pub const KEEP_ALIVE_TIMEOUT: Duration = Duration::from_secs(10);
/// Length of a token in characters.
const TOKEN_LENGTHS: std::ops::RangeInclusive<usize> = 16..=512;

/// A client of a coordinator: message sizes are limited, and each call carries version and token.
pub type Client = CoordinatorClient<InterceptedService<Channel, Credentials>>;

/// A shared secret that authenticates callers. It is never printed.
#[derive(Clone, PartialEq, Eq)]
pub struct Token(String);

impl Token {
    /// A token of 16 to 512 printable ASCII characters without spaces; surrounding white space is removed.
    ///
    /// # Errors
    /// What is wrong with it, without repeating it.
    pub fn new(text: &str) -> Result<Self, &'static str> {
        let text = text.trim();
        if TOKEN_LENGTHS.contains(&text.len()) && text.bytes().all(|byte| byte.is_ascii_graphic()) {
            Ok(Self(text.to_string()))
        } else {
            Err("holds no token: 16 to 512 printable ASCII characters on one line")
        }
    }

    fn header(&self) -> AsciiMetadataValue {
        let value = AsciiMetadataValue::try_from(format!("Bearer {}", self.0));
        let mut value = value.expect("a token is printable ASCII");
        value.set_sensitive(true);
        value
    }

    /// Whether an authorization header is `Bearer` and this token. Compares in constant time: the hashes of both, every byte.
    pub fn matches(&self, header: &[u8]) -> bool {
        let [own, other] = [self.header().as_bytes(), header].map(|bytes| ArtefactId::of(bytes).0);
        own.iter().zip(other).fold(0, |differ, (own, other)| differ | (own ^ other)) == 0
    }
}

impl fmt::Debug for Token {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("Token(…)")
    }
}

/// A certificate chain and its private key, both PEM.
#[derive(Clone, PartialEq, Eq)]
pub struct KeyPair {
    /// The chain, own certificate first.
    pub certificate: Vec<u8>,
    /// Its private key.
    pub key: Vec<u8>,
}

impl KeyPair {
    /// In tonic's type.
    pub fn identity(&self) -> Identity {
        Identity::from_pem(&self.certificate, &self.key)
    }
}

impl fmt::Debug for KeyPair {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("KeyPair(…)")
    }
}

/// A client's credentials, and the certificates by which it verifies the coordinator.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Access {
    /// Trusted root certificates, PEM.
    pub authority: Option<Vec<u8>>,
    /// The client's certificate, if the coordinator requires one.
    pub identity: Option<KeyPair>,
    /// The token, if the coordinator requires one.
    pub token: Option<Token>,
}

/// A client of the coordinator at this URL. It connects with its first call, and reconnects when the connection is lost.
///
/// # Errors
/// An invalid URL, or one that does not fit the credentials: TLS needs a root certificate, and a token is sent to other machines only
/// over TLS.
pub fn connect(url: &str, access: &Access) -> Result<Client, BadInput> {
    let bad = |problem: String, advice: &str| BadInput::new("--coordinator", format!("'{url}' {problem}"), advice);
    let endpoint = Endpoint::from_shared(url.to_string())
        .map_err(|error| bad(format!("is not a URL ({error})"), "give it as http://host:port or https://host:port"))?;
    let uri = endpoint.uri().clone();
    let host = uri.host().unwrap_or_default().trim_matches(['[', ']']);
    let is_local = host == "localhost" || host.parse().is_ok_and(|address: std::net::IpAddr| address.is_loopback());
    let mut endpoint = endpoint
        .connect_timeout(CONNECT_TIMEOUT)
        .timeout(CALL_TIMEOUT)
        .tcp_nodelay(true)
        .http2_keep_alive_interval(KEEP_ALIVE)
        .keep_alive_timeout(KEEP_ALIVE_TIMEOUT)
        .keep_alive_while_idle(true);
    match (uri.scheme_str(), &access.authority) {
        (Some("https"), Some(authority)) => {
            let mut tls = ClientTlsConfig::new().ca_certificate(Certificate::from_pem(authority));
            tls = tls.timeout(CONNECT_TIMEOUT);
            if let Some(pair) = &access.identity {
                tls = tls.identity(pair.identity());
            }
            endpoint = endpoint.tls_config(tls).map_err(|error| {
                BadInput::new(
                    "--tls-ca",
                    format!("cannot be used ({})", root_cause(&error)),
                    "give certificates as PEM",
                )
            })?;
        }
        (Some("https"), None) => {
            let advice = "give --tls-ca with the certificate that signed the coordinator's";
            return Err(bad("is encrypted, and no trusted certificate is given".into(), advice));
        }
        (Some("http"), None) if access.identity.is_none() => {
            if access.token.is_some() && !is_local {
                let problem = "is on another machine and not encrypted: the token could be read on the network";
                return Err(bad(problem.into(), "give it as https:// with --tls-ca"));
            }
        }
        (Some("http"), _) => {
            return Err(bad("is not encrypted, but certificates are given".into(), "give it as https://host:port"));
        }
        _ => {
            return Err(bad(
                "is not the URL of a coordinator".into(),
                "give it as http://host:port or https://host:port",
            ));
        }
    }
    Ok(client(endpoint.connect_lazy(), access.token.as_ref()))
}

/// A client over a channel.
pub fn client(channel: Channel, token: Option<&Token>) -> Client {
    CoordinatorClient::with_interceptor(channel, Credentials { bearer: token.map(Token::header) })
        .max_decoding_message_size(MESSAGE_BYTES_LIMIT)
        .max_encoding_message_size(MESSAGE_BYTES_LIMIT)
}

/// Adds version and token to the headers of each call.
#[derive(Debug, Clone)]
pub struct Credentials {
    bearer: Option<AsciiMetadataValue>,
}

impl Interceptor for Credentials {
    fn call(&mut self, mut request: Request<()>) -> Result<Request<()>, Status> {
        request.metadata_mut().insert(VERSION_HEADER, AsciiMetadataValue::from(VERSION));
        if let Some(bearer) = &self.bearer {
            request.metadata_mut().insert("authorization", bearer.clone());
        }
        Ok(request)
    }
}

/// Refuses calls without the token, if there is one, and calls of unsupported protocol versions.
#[derive(Debug, Clone, Default)]
pub struct Guard {
    /// The required token; `None` = none.
    pub token: Option<Token>,
}

impl Interceptor for Guard {
    fn call(&mut self, request: Request<()>) -> Result<Request<()>, Status> {
        let header = request.metadata();
        if let Some(token) = &self.token {
            match header.get("authorization") {
                Some(header) if token.matches(header.as_bytes()) => {}
                Some(_) => {
                    return Err(Status::unauthenticated("the token is not this coordinator's; give --token-file"));
                }
                None => return Err(Status::unauthenticated("this coordinator requires a token; give --token-file")),
            }
        }
        let version = header.get(VERSION_HEADER).and_then(|value| value.to_str().ok()?.parse::<u32>().ok());
        match version {
            Some(MIN_VERSION..=VERSION) => Ok(request),
            Some(newer) if newer > VERSION => Err(Status::failed_precondition(format!(
                "the caller uses protocol version {newer}, this coordinator supports none above {VERSION}; \
                 update the coordinator"
            ))),
            older => Err(Status::failed_precondition(format!(
                "the caller is too old: it uses protocol {}, this coordinator supports none below {MIN_VERSION}; update it",
                older.map_or("without a version".into(), |older| format!("version {older}")),
            ))),
        }
    }
}

/// A status's message and, for a connection error, its root cause.
pub fn explain(status: &Status) -> String {
    match status.source() {
        Some(source) => crate::one_line(&format!("{} ({})", status.message(), root_cause(source))),
        None => crate::one_line(status.message()),
    }
}

/// The message of the last error in the chain of sources.
pub fn root_cause(error: &dyn Error) -> String {
    let mut root = error;
    while let Some(source) = root.source() {
        root = source;
    }
    root.to_string()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_token_matches_as_a_whole_and_is_never_printed() {
        let token = Token::new(" 0123456789abcdef\n").unwrap();
        assert!(token.matches(b"Bearer 0123456789abcdef"));
        for wrong in [&b""[..], b"Bearer ", b"0123456789abcdef", b"Bearer 0123456789abcde", b"Bearer 0123456789abcdeff"]
        {
            assert!(!token.matches(wrong));
        }
        for bad in ["", "short", "two words of a token", "é0123456789abcdef", &"x".repeat(513)] {
            assert!(Token::new(bad).is_err(), "{bad}");
        }
        let access = Access { token: Some(token), ..Access::default() };
        assert!(!format!("{access:?} {:?}", client_header(&access)).contains("0123456789"));
    }

    fn client_header(access: &Access) -> Request<()> {
        let mut credentials = Credentials { bearer: access.token.as_ref().map(Token::header) };
        credentials.call(Request::new(())).unwrap()
    }

    #[test]
    fn unsupported_versions_are_refused_with_the_side_to_update() {
        let mut guard = Guard::default();
        assert!(guard.call(client_header(&Access::default())).is_ok());
        let mut refused = |version: Option<&'static str>| {
            let mut request = Request::new(());
            if let Some(version) = version {
                request.metadata_mut().insert(VERSION_HEADER, AsciiMetadataValue::from_static(version));
            }
            guard.call(request).unwrap_err().message().to_string()
        };
        assert!(refused(None).contains("too old"));
        assert!(refused(Some("1")).contains("version 1"));
        assert!(refused(Some("two")).contains("too old"));
        assert!(refused(Some("4294967295")).contains("update the coordinator"));
    }

    #[tokio::test]
    async fn a_token_is_not_sent_unencrypted_to_other_machines() {
        let access = Access { token: Some(Token::new("0123456789abcdef").unwrap()), ..Access::default() };
        for fine in ["http://127.0.0.1:7", "http://localhost:7", "http://[::1]:7"] {
            assert!(connect(fine, &access).is_ok(), "{fine}");
        }
        let authority = Access { authority: Some(b"no certificate".to_vec()), ..Access::default() };
        for (bad, access) in [
            ("http://10.0.0.1:7", &access),
            ("https://10.0.0.1:7", &access),
            ("http://127.0.0.1:7", &authority),
            ("ftp://127.0.0.1:7", &access),
            ("no url", &access),
            ("", &access),
        ] {
            assert!(connect(bad, access).is_err(), "{bad}");
        }
    }
}
