//! Where the coordinator may listen, and how whoever calls is told from a stranger.

use std::net::SocketAddr;
use std::time::Duration;

use proto::{Guard, KeyPair, Token, root_cause};
use scene::BadInput;
use tonic::transport::{Certificate, ServerTlsConfig};

/// A stranger that connects and says nothing is dropped after this long.
const HANDSHAKE_TIMEOUT: Duration = Duration::from_secs(10);

/// Encryption and proofs. On this machine alone neither is needed.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Security {
    /// The coordinator's certificate: with it the wire is encrypted.
    pub identity: Option<KeyPair>,
    /// Certificates, PEM: where they are given, whoever calls needs one that these signed.
    pub client_authority: Option<Vec<u8>>,
    /// What whoever calls must know.
    pub token: Option<Token>,
}

impl Security {
    /// Whether it is enough for this address.
    ///
    /// # Errors
    /// An address that other machines reach, without certificate or without token; proofs without encryption.
    pub fn check(&self, address: SocketAddr) -> Result<(), BadInput> {
        if self.client_authority.is_some() && self.identity.is_none() {
            let problem = "asks for the callers' certificates, and the coordinator has none itself";
            return Err(BadInput::new("--tls-client-ca", problem, "give --tls-cert and --tls-key as well"));
        }
        let lacks = match (&self.identity, &self.token) {
            _ if address.ip().is_loopback() => return Ok(()),
            (Some(_), Some(_)) => return Ok(()),
            (None, Some(_)) => "the wire would not be encrypted",
            (Some(_), None) => "anyone could call",
            (None, None) => "the wire would be neither encrypted nor asking for a token",
        };
        let problem = format!("is reachable from other machines, and {lacks}");
        let advice = "give --tls-cert, --tls-key and --token-file, or listen on 127.0.0.1 or [::1]";
        Err(BadInput::new(address.to_string(), problem, advice))
    }

    /// As the server wants it, where there is encryption.
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

/// What is wrong with certificate or key.
pub(crate) fn unusable(error: &tonic::transport::Error) -> BadInput {
    let problem = format!("cannot be used with its key ({})", root_cause(error));
    BadInput::new("--tls-cert", problem, "give a certificate and its private key as PEM")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn beyond_this_machine_both_certificate_and_token_are_needed() {
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
        let proofs = Security { client_authority: Some(Vec::new()), ..Security::default() };
        assert!(proofs.check("127.0.0.1:80".parse().unwrap()).is_err());
    }
}
