//! Who may ask: on the loopback everyone on this machine, beyond it those who have the token. And what a page of another site may not do
//! with a browser that is allowed to.

use std::net::SocketAddr;

use axum::extract::{Request, State};
use axum::http::header::{AUTHORIZATION, CONTENT_TYPE, HOST};
use axum::http::{HeaderMap, HeaderValue, Method, StatusCode};
use axum::middleware::Next;
use axum::response::{IntoResponse, Response};
use base64::Engine;
use base64::engine::general_purpose::STANDARD as BASE64;
use proto::Token;
use scene::BadInput;

use crate::refused::{Refused, refusal};

/// Checks requests.
#[derive(Debug, Clone)]
pub(crate) struct Access {
    token: Option<Token>,
    /// Names under which the loopback is asked; a page of another site that has its own name point to the loopback uses that name.
    loopback: bool,
}

impl Access {
    /// Access to a server that listens here.
    ///
    /// # Errors
    /// An address that other machines reach, without encryption or without a token.
    pub(crate) fn new(address: SocketAddr, token: Option<Token>, encrypted: bool) -> Result<Self, BadInput> {
        let loopback = address.ip().is_loopback();
        if !loopback && (token.is_none() || !encrypted) {
            let problem = "is reachable from other machines, and connections would not be encrypted and authenticated";
            let advice = "give --tls-cert, --tls-key and --token-file, or listen on 127.0.0.1 or [::1]";
            return Err(BadInput::new(address.to_string(), problem, advice));
        }
        Ok(Self { token, loopback })
    }

    fn check(&self, method: &Method, headers: &HeaderMap) -> Result<(), Refused> {
        if self.loopback && !headers.get(HOST).is_none_or(is_loopback_name) {
            return Err(refusal(StatusCode::FORBIDDEN, "this server is asked as localhost, 127.0.0.1 or [::1]"));
        }
        if let Some(token) = &self.token
            && !headers.get(AUTHORIZATION).is_some_and(|header| carries(header, token))
        {
            return Err(refusal(StatusCode::UNAUTHORIZED, "give the token as password; any user name will do"));
        }
        // A form of another site cannot send JSON without asking first, which is not answered.
        let is_json = headers.get(CONTENT_TYPE).is_some_and(|kind| kind.as_bytes().starts_with(b"application/json"));
        if method != Method::GET && method != Method::HEAD && method != Method::OPTIONS && !is_json {
            return Err(refusal(StatusCode::UNSUPPORTED_MEDIA_TYPE, "send JSON with content-type: application/json"));
        }
        Ok(())
    }
}

/// Refuses what is not allowed.
pub(crate) async fn guard(State(access): State<Access>, request: Request, next: Next) -> Response {
    // Whether the process is alive is no secret, and load balancers have no token.
    if request.uri().path() == "/healthz" {
        return next.run(request).await;
    }
    match access.check(request.method(), request.headers()) {
        Ok(()) => next.run(request).await,
        Err(refused) => refused.into_response(),
    }
}

fn is_loopback_name(host: &HeaderValue) -> bool {
    let Ok(host) = host.to_str() else { return false };
    let name = match host.rsplit_once(':') {
        Some((name, port)) if port.bytes().all(|byte| byte.is_ascii_digit()) => name,
        _ => host,
    };
    let name = name.trim_matches(['[', ']']);
    name == "localhost" || name.parse().is_ok_and(|address: std::net::IpAddr| address.is_loopback())
}

/// Whether an authorization header carries the token: as `Bearer`, or as the password of `Basic`.
fn carries(header: &HeaderValue, token: &Token) -> bool {
    let bytes = header.as_bytes();
    let Some(basic) = bytes.strip_prefix(b"Basic ") else { return token.matches(bytes) };
    let Ok(decoded) = BASE64.decode(basic) else { return false };
    let password = decoded.iter().position(|byte| *byte == b':').map(|colon| &decoded[colon + 1..]);
    password.is_some_and(|password| token.matches(&[b"Bearer ", password].concat()))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn headers(lines: &[(axum::http::HeaderName, &str)]) -> HeaderMap {
        lines.iter().map(|(name, value)| (name.clone(), HeaderValue::from_str(value).unwrap())).collect()
    }

    #[test]
    fn beyond_the_loopback_a_token_and_tls_are_needed() {
        let token = || Token::new("0123456789abcdef").ok();
        let (local, beyond) = ("127.0.0.1:80".parse().unwrap(), "0.0.0.0:80".parse().unwrap());
        assert!(Access::new(local, None, false).is_ok());
        assert!(Access::new(beyond, token(), true).is_ok());
        for (token, encrypted) in [(None, true), (token(), false), (None, false)] {
            assert!(Access::new(beyond, token, encrypted).is_err());
        }
        let access = Access::new(beyond, token(), true).unwrap();
        let check = |authorization: &str| {
            access.check(&Method::GET, &headers(&[(AUTHORIZATION, authorization), (HOST, "a.example")])).is_ok()
        };
        // "anyone:0123456789abcdef" and "anyone:other".
        assert!(check("Bearer 0123456789abcdef") && check("Basic YW55b25lOjAxMjM0NTY3ODlhYmNkZWY="));
        assert!(!check("Bearer other") && !check("Basic YW55b25lOm90aGVy") && !check("Basic %%%") && !check(""));
        assert!(access.check(&Method::GET, &headers(&[])).is_err());
    }

    #[test]
    fn pages_of_other_sites_cannot_use_a_browser() {
        let access = Access::new("127.0.0.1:80".parse().unwrap(), None, false).unwrap();
        for (host, fine) in [
            ("localhost:8080", true),
            ("127.0.0.1", true),
            ("[::1]:80", true),
            ("evil.example:80", false),
            ("127.0.0.1.evil.example", false),
        ] {
            assert_eq!(access.check(&Method::GET, &headers(&[(HOST, host)])).is_ok(), fine, "{host}");
        }
        for (kind, fine) in
            [("application/json", true), ("text/plain", false), ("application/x-www-form-urlencoded", false)]
        {
            assert_eq!(access.check(&Method::POST, &headers(&[(CONTENT_TYPE, kind)])).is_ok(), fine, "{kind}");
        }
        assert!(access.check(&Method::POST, &headers(&[])).is_err());
    }
}
