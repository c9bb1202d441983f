//! URLs of sockets, such as `tcp://HOST:PORT`.

use std::fmt;
use std::net::{SocketAddr, ToSocketAddrs};
use std::str::FromStr;

use crate::downlink::error::SocketError;

/// Address at which a ground listens: for connections (`tcp://`) or for datagrams (`udp://`).
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum ListenUrl {
    /// Address for connections.
    Tcp(TcpUrl),
    /// Address for datagrams.
    Udp(TcpUrl),
}

impl FromStr for ListenUrl {
    type Err = SocketError;

    fn from_str(text: &str) -> Result<Self, SocketError> {
        match text.strip_prefix("udp://") {
            Some(rest) => match format!("tcp://{rest}").parse() {
                Ok(url) => Ok(Self::Udp(url)),
                Err(_) => Err(SocketError::Url { text: text.to_owned() }),
            },
            None => text.parse().map(Self::Tcp),
        }
    }
}

pub(super) fn udp_url(address: SocketAddr) -> String {
    TcpUrl::from(address).to_string().replacen("tcp", "udp", 1)
}

/// The host and port of a TCP socket.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct TcpUrl {
    host: String,
    port: u16,
}

impl TcpUrl {
    /// The addresses of the host.
    ///
    /// # Errors
    /// The host has no address.
    pub fn addresses(&self) -> Result<Vec<SocketAddr>, SocketError> {
        let found = (self.host.as_str(), self.port).to_socket_addrs().map(Vec::from_iter);
        match found {
            Ok(found) if !found.is_empty() => Ok(found),
            Ok(_) => Err(SocketError::Resolve {
                url: self.to_string(),
                source: std::io::ErrorKind::NotFound.into(),
            }),
            Err(source) => Err(SocketError::Resolve { url: self.to_string(), source }),
        }
    }

    /// The addresses of the host, if all are loopback addresses.
    ///
    /// # Errors
    /// [`SocketError::Remote`]; the host has no address.
    pub fn loopback_addresses(&self) -> Result<Vec<SocketAddr>, SocketError> {
        let found = self.addresses()?;
        match found.iter().all(|address| address.ip().to_canonical().is_loopback()) {
            true => Ok(found),
            // Without the scheme, as the address may be that of a `udp` URL.
            false => {
                Err(SocketError::Remote { address: self.to_string().trim_start_matches("tcp://").to_owned() })
            }
        }
    }
}

impl From<SocketAddr> for TcpUrl {
    fn from(address: SocketAddr) -> Self {
        Self { host: address.ip().to_string(), port: address.port() }
    }
}

impl FromStr for TcpUrl {
    type Err = SocketError;

    fn from_str(text: &str) -> Result<Self, SocketError> {
        let parse = || {
            let (host, port) = text.strip_prefix("tcp://")?.rsplit_once(':')?;
            let port = port.bytes().all(|digit| digit.is_ascii_digit()).then(|| port.parse().ok())??;
            let host = match host.strip_prefix('[') {
                Some(rest) => {
                    rest.strip_suffix(']').filter(|host| host.parse::<std::net::Ipv6Addr>().is_ok())?
                }
                None => host,
            };
            let is_forbidden = |c: char| c.is_whitespace() || c.is_control() || "/@[]?#".contains(c);
            let is_ipv6 = text.contains('[');
            let is_valid =
                !host.is_empty() && !host.contains(is_forbidden) && (is_ipv6 || !host.contains(':'));
            is_valid.then(|| Self { host: host.to_owned(), port })
        };
        parse().ok_or_else(|| SocketError::Url { text: text.to_owned() })
    }
}

impl fmt::Display for TcpUrl {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { host, port } = self;
        match host.contains(':') {
            true => write!(f, "tcp://[{host}]:{port}"),
            false => write!(f, "tcp://{host}:{port}"),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn urls_are_parsed_and_displayed() {
        for text in
            ["tcp://127.0.0.1:4711", "tcp://[::1]:0", "tcp://localhost:65535", "tcp://ground.example:1"]
        {
            assert_eq!(text.parse::<TcpUrl>().unwrap().to_string(), text);
        }
        for text in [
            "",
            "127.0.0.1:4711",
            "tcp://",
            "tcp://:1",
            "tcp://host",
            "tcp://host:",
            "tcp://host:65536",
            "tcp://host:+1",
            "tcp://::1:4711",
            "tcp://[::1:4711",
            "tcp://[host]:1",
            "udp://host:1",
            "tcp://host:1/",
            "tcp://a b:1",
            "tcp://me@host:1",
        ] {
            let error = text.parse::<TcpUrl>().unwrap_err().to_string();
            assert!(error.contains("expected tcp://HOST:PORT") && error.contains(text), "{error}");
        }
    }

    #[test]
    fn only_loopback_addresses_are_loopback() {
        for (text, is_loopback) in [
            ("tcp://127.0.0.1:1", true),
            ("tcp://127.9.9.9:1", true),
            ("tcp://[::1]:1", true),
            ("tcp://[::ffff:127.0.0.1]:1", true),
            ("tcp://0.0.0.0:1", false),
            ("tcp://[::]:1", false),
            ("tcp://192.0.2.7:1", false),
            ("tcp://[2001:db8::7]:1", false),
        ] {
            assert_eq!(text.parse::<TcpUrl>().unwrap().loopback_addresses().is_ok(), is_loopback, "{text}");
        }
    }
}
