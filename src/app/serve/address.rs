//! The address on which the server listens, and the check of `Host` headers.

use std::fmt;
use std::net::{IpAddr, SocketAddr, TcpListener, ToSocketAddrs};
use std::str::FromStr;

use super::error::ServeError;

/// A host and a port; `PORT` alone means the loopback address.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ServeAddress {
    host: String,
    port: u16,
}

impl ServeAddress {
    /// Listens on this address. Addresses other than loopback need `allow_remote`.
    ///
    /// # Errors
    /// [`ServeError`]: an unknown host, an address that is not allowed, or a port in use.
    pub(super) fn bind(&self, allow_remote: bool) -> Result<TcpListener, ServeError> {
        let address = self.to_string();
        let found = (self.host.as_str(), self.port).to_socket_addrs().map(Vec::from_iter);
        let found = found.map_err(|source| ServeError::Resolve { address: address.clone(), source })?;
        if !allow_remote && !found.iter().all(|found| is_loopback(found.ip())) {
            return Err(ServeError::Remote { address });
        }
        TcpListener::bind(found.as_slice()).map_err(|source| ServeError::Bind { address, source })
    }
}

/// Whether an address is loopback, so that no other machine can reach it.
fn is_loopback(address: IpAddr) -> bool {
    address.to_canonical().is_loopback()
}

/// Whether a `Host` header names the loopback address and the port of `server`. Any other name may be a DNS rebinding attack, with
/// which a foreign page could read this one.
pub(super) fn is_loopback_host(host: &str, server: SocketAddr) -> bool {
    let (name, port) = match host.rsplit_once(':') {
        Some((name, port)) if !port.ends_with(']') => (name, Some(port)),
        _ => (host, None),
    };
    let name = name.strip_prefix('[').and_then(|name| name.strip_suffix(']')).unwrap_or(name);
    let is_local = name.eq_ignore_ascii_case("localhost") || name.parse().is_ok_and(is_loopback);
    is_local && port.is_none_or(|port| port.parse() == Ok(server.port()))
}

impl FromStr for ServeAddress {
    type Err = ServeError;

    fn from_str(text: &str) -> Result<Self, ServeError> {
        let parse = || {
            let (host, port) = text.rsplit_once(':').unwrap_or(("127.0.0.1", text));
            let port = port.bytes().all(|digit| digit.is_ascii_digit()).then(|| port.parse().ok())??;
            let ipv6 = host.strip_prefix('[').and_then(|host| host.strip_suffix(']'));
            let is_valid = match ipv6 {
                Some(ipv6) => ipv6.parse::<std::net::Ipv6Addr>().is_ok(),
                None => {
                    !host.is_empty()
                        && host.bytes().all(|b| b.is_ascii_alphanumeric() || b == b'.' || b == b'-')
                }
            };
            is_valid.then(|| Self { host: ipv6.unwrap_or(host).to_owned(), port })
        };
        parse().ok_or_else(|| ServeError::Address { text: text.to_owned() })
    }
}

impl fmt::Display for ServeAddress {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { host, port } = self;
        match host.contains(':') {
            true => write!(f, "[{host}]:{port}"),
            false => write!(f, "{host}:{port}"),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn addresses_are_parsed() {
        for (text, expected) in [
            ("8080", "127.0.0.1:8080"),
            ("0", "127.0.0.1:0"),
            ("127.0.0.1:80", "127.0.0.1:80"),
            ("localhost:1", "localhost:1"),
            ("[::1]:65535", "[::1]:65535"),
            ("0.0.0.0:1", "0.0.0.0:1"),
        ] {
            assert_eq!(text.parse::<ServeAddress>().unwrap().to_string(), expected);
        }
        for text in [
            "",
            ":",
            ":80",
            "host",
            "host:",
            "65536",
            "::1:80",
            "[::1]",
            "[host]:1",
            "http://a:1",
            "a b:1",
            "+1",
        ] {
            let error = text.parse::<ServeAddress>().unwrap_err().to_string();
            assert!(error.contains("expected PORT or HOST:PORT"), "{text}: {error}");
        }
    }

    #[test]
    fn remote_addresses_need_permission() {
        let refused = |text: &str| text.parse::<ServeAddress>().unwrap().bind(false).is_err();
        assert!(refused("0.0.0.0:0") && refused("[::]:0") && refused("192.0.2.7:0"));
        assert!(!refused("127.0.0.1:0") && !refused("0"));
        assert!("0.0.0.0:0".parse::<ServeAddress>().unwrap().bind(true).is_ok());
    }

    #[test]
    fn only_loopback_hosts_are_accepted() {
        let server = SocketAddr::from(([127, 0, 0, 1], 8080));
        for host in ["localhost:8080", "127.0.0.1:8080", "LOCALHOST", "[::1]:8080", "[::1]", "127.9.9.9:8080"]
        {
            assert!(is_loopback_host(host, server), "{host}");
        }
        for host in [
            "",
            "evil.example",
            "evil.example:8080",
            "localhost.evil.example:8080",
            "localhost:80",
            "127.0.0.1.evil.example",
            "192.0.2.7:8080",
            "localhost:",
            "[::2]:8080",
        ] {
            assert!(!is_loopback_host(host, server), "{host}");
        }
    }
}
