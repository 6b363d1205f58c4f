//! The coordinator's listen address, TLS and authentication of clients.

use std::net::SocketAddr;
use std::time::Duration;

use proto::{Guard, KeyPair, Token, root_cause};
use scene::BadInput;
use tonic::transport::{Certificate, ServerTlsConfig};

/// Time limit of a TLS handshake.
const HANDSHAKE_TIMEOUT: Duration = Duration::from_secs(10);

/// TLS and authentication. Neither is required on the loopback.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Security {
    /// The coordinator's certificate, which enables TLS.
    pub identity: Option<KeyPair>,
    /// Root certificates, PEM: if given, clients need a certificate that these signed.
    pub client_authority: Option<Vec<u8>>,
    /// The token that clients must send.
    pub token: Option<Token>,
}

impl Security {
    /// Checks that it suffices for a listen address.
    ///
    /// # Errors
    /// An address that other machines reach without certificate or token; client certificates without TLS.
    pub fn check(&self, address: SocketAddr) -> Result<(), BadInput> {
        if self.client_authority.is_some() && self.identity.is_none() {
            let problem = "requires client certificates, but the coordinator has no certificate itself";
            return Err(BadInput::new("--tls-client-ca", problem, "give --tls-cert and --tls-key as well"));
        }
        let lacks = match (&self.identity, &self.token) {
            _ if address.ip().is_loopback() => return Ok(()),
            (Some(_), Some(_)) => return Ok(()),
            (None, Some(_)) => "connections would not be encrypted",
            (Some(_), None) => "anyone could call",
            (None, None) => "connections would be neither encrypted nor authenticated",
        };
        let problem = format!("is reachable from other machines, and {lacks}");
        let advice = "give --tls-cert, --tls-key and --token-file, or listen on 127.0.0.1 or [::1]";
        Err(BadInput::new(address.to_string(), problem, advice))
    }

    /// In tonic's type; `None` without a certificate.
    pub(crate) fn tls(&self) -> Option<ServerTlsConfig> {
        let mut tls = ServerTlsConfig::new().identity(self.identity.as_ref()?.identity()).timeout(HANDSHAKE_TIMEOUT);
        if let Some(authority) = &self.client_authority {
            tls = tls.client_ca_root(Certificate::from_pem(authority));
        }
        Some(tls)
    }

    pub(crate) fn guard(&self) -> Guard {
        Guard { token: self.token.clone() }
    }
}

/// The error of an invalid certificate or key.
pub(crate) fn unusable(error: &tonic::transport::Error) -> BadInput {
    let problem = format!("cannot be used with its key ({})", root_cause(error));
    BadInput::new("--tls-cert", problem, "give a certificate and its private key as PEM")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn beyond_the_loopback_certificate_and_token_are_required() {
        let pair = KeyPair { certificate: Vec::new(), key: Vec::new() };
        let token = Token::new("0123456789abcdef").ok();
        let all = Security { identity: Some(pair), client_authority: None, token };
        let without_token = Security { token: None, ..all.clone() };
        let without_tls = Security { identity: None, ..all.clone() };
        for local in ["127.0.0.1:80", "127.8.8.8:80", "[::1]:80"] {
            assert!(Security::default().check(local.parse().unwrap()).is_ok(), "{local}");
        }
        for beyond in ["0.0.0.0:80", "[::]:80", "10.0.0.1:80"] {
            let check = |security: &Security| security.check(beyond.parse().unwrap());
            assert!(check(&all).is_ok());
            assert!(check(&without_token).unwrap_err().problem.contains("anyone"));
            assert!(check(&without_tls).unwrap_err().problem.contains("encrypted"));
            assert!(check(&Security::default()).is_err());
        }
        let client_certificates = Security { client_authority: Some(Vec::new()), ..Security::default() };
        assert!(client_certificates.check("127.0.0.1:80".parse().unwrap()).is_err());
    }
}
