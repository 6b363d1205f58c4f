//! Tells a rejected certificate from a network error.
//!
//! In TLS 1.3 a client's handshake ends before the server has checked the client's certificate. The server's alert then arrives on a
//! connection that already carries HTTP/2, and gRPC reports it as one of several transient errors, or loses it to a reset. A connection
//! that only shakes hands and reads receives the alert reliably.

use std::io;
use std::sync::Arc;
use std::time::Duration;

use scene::BadInput;
use tokio::io::AsyncReadExt;
use tokio::net::TcpStream;
use tokio_rustls::TlsConnector;
use tokio_rustls::rustls::pki_types::pem::PemObject;
use tokio_rustls::rustls::pki_types::{CertificateDer, PrivateKeyDer, ServerName};
use tokio_rustls::rustls::{self, AlertDescription, ClientConfig, RootCertStore};
use tonic::codegen::http::Uri;

use crate::Access;

/// Time limit of the whole connection.
const TIMEOUT: Duration = Duration::from_secs(5);
/// Time limit of the wait for an alert after the handshake. A server that accepts the client sends HTTP/2 settings at once.
const ALERT_TIMEOUT: Duration = Duration::from_secs(2);

/// Connects to a coordinator's `https://` URL and returns why the certificates of `access` can never work with it. `None` if they are
/// accepted, and after any other error, such as a refused connection, which may be transient.
pub async fn rejected_certificate(url: &str, access: &Access) -> Option<BadInput> {
    let uri: Uri = url.parse().ok().filter(|uri: &Uri| uri.scheme_str() == Some("https"))?;
    let tls = client_config(access)?;
    let error = tokio::time::timeout(TIMEOUT, handshake(&uri, tls)).await.ok()?.err()?;
    bad_certificate(url, access, error.get_ref()?.downcast_ref()?)
}

/// `None` if the certificates cannot be parsed, which [`connect`](crate::connect) reports.
fn client_config(access: &Access) -> Option<ClientConfig> {
    let certificates = |pem: &[u8]| CertificateDer::pem_slice_iter(pem).collect::<Result<Vec<_>, _>>().ok();
    let mut roots = RootCertStore::empty();
    for certificate in certificates(access.authority.as_ref()?)? {
        roots.add(certificate).ok()?;
    }
    let provider = Arc::new(rustls::crypto::ring::default_provider());
    let builder = ClientConfig::builder_with_provider(provider).with_safe_default_protocol_versions().ok()?;
    let builder = builder.with_root_certificates(roots);
    let mut config = match &access.identity {
        Some(pair) => {
            let key = PrivateKeyDer::from_pem_slice(&pair.key).ok()?;
            builder.with_client_auth_cert(certificates(&pair.certificate)?, key).ok()?
        }
        None => builder.with_no_client_auth(),
    };
    config.alpn_protocols = vec![b"h2".to_vec()];
    Some(config)
}

/// Shakes hands, and reads until the server has accepted or rejected the client.
async fn handshake(uri: &Uri, tls: ClientConfig) -> io::Result<()> {
    let host = uri.host().unwrap_or_default().trim_matches(['[', ']']).to_owned();
    let stream = TcpStream::connect((host.as_str(), uri.port_u16().unwrap_or(443))).await?;
    let name = ServerName::try_from(host).map_err(io::Error::other)?;
    let mut stream = TlsConnector::from(Arc::new(tls)).connect(name, stream).await?;
    match tokio::time::timeout(ALERT_TIMEOUT, stream.read(&mut [0; 1])).await {
        Ok(read) => read.map(|_| ()),
        Err(_) => Ok(()),
    }
}

/// The error if a TLS error is about a certificate.
fn bad_certificate(url: &str, access: &Access, error: &rustls::Error) -> Option<BadInput> {
    use AlertDescription as Alert;
    match error {
        rustls::Error::InvalidCertificate(reason) => {
            let problem = format!("the certificate of the coordinator {url} is not valid under it ({reason})");
            Some(BadInput::new("--tls-ca", problem, "give the certificate that signed the coordinator's"))
        }
        rustls::Error::AlertReceived(alert) => match alert {
            Alert::CertificateRequired => {
                let problem = format!("the coordinator {url} requires a client certificate, and none is given");
                let advice = "give --tls-cert and --tls-key, signed by the coordinator's --tls-client-ca";
                Some(BadInput::new("--tls-cert", problem, advice))
            }
            Alert::BadCertificate
            | Alert::UnsupportedCertificate
            | Alert::CertificateRevoked
            | Alert::CertificateExpired
            | Alert::CertificateUnknown
            | Alert::UnknownCA
            | Alert::AccessDenied
            | Alert::DecryptError
                if access.identity.is_some() =>
            {
                let problem = format!("the coordinator {url} rejects the client certificate (TLS alert {alert:?})");
                let advice =
                    "give --tls-cert and --tls-key of a certificate that the coordinator's --tls-client-ca signed";
                Some(BadInput::new("--tls-cert", problem, advice))
            }
            _ => None,
        },
        _ => None,
    }
}
