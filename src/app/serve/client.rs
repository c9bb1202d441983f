//! A minimal HTTP client for the server's JSON.

use std::io::{self, Read, Write};
use std::net::{TcpStream, ToSocketAddrs};
use std::time::{Duration, Instant};

use thiserror::Error;

use super::address::ServeAddress;

/// Time limit for a connection, and for the next bytes of a response.
const STEP_TIMEOUT: Duration = Duration::from_secs(5);

/// Time limit for a whole exchange.
const EXCHANGE_TIMEOUT: Duration = Duration::from_secs(10);

/// Maximum size of a response, bytes. A status of 1000 channels has some 1 MB.
const RESPONSE_BYTES_MAX: u64 = 64 << 20;

/// Errors of a request.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum ClientError {
    /// No server listens at the address, or the connection was lost.
    #[error("cannot read http://{address}{path}; expected a command that runs with --serve {address}")]
    Connection {
        /// Address of the server.
        address: String,
        /// Requested path.
        path: String,
        /// The system's error.
        source: io::Error,
    },
    /// A response that is not 200 with JSON.
    #[error("http://{address}{path} answered `{answer}`; expected 200 and the JSON of a lunarray server")]
    Answer {
        /// Address of the server.
        address: String,
        /// Requested path.
        path: String,
        /// First line of the response, or what is wrong with it.
        answer: String,
    },
}

/// Client of a server; it opens a connection for each request.
#[derive(Clone, Debug)]
pub struct Client {
    address: ServeAddress,
}

impl Client {
    /// A client of the server at `address`.
    #[must_use]
    pub fn new(address: ServeAddress) -> Self {
        Self { address }
    }

    /// The server's address.
    #[must_use]
    pub fn address(&self) -> String {
        self.address.to_string()
    }

    /// Requests the JSON at a path such as `/api/status`.
    ///
    /// # Errors
    /// [`ClientError`]: no connection, no response within seconds, or a response that is not 200 with JSON.
    pub fn json(&self, path: &str) -> Result<serde_json::Value, ClientError> {
        let answer = self.exchange(path).map_err(|source| ClientError::Connection {
            address: self.address(),
            path: path.to_owned(),
            source,
        })?;
        body(&answer)
            .and_then(|body| serde_json::from_slice(body).map_err(|error| error.to_string()))
            .map_err(|answer| ClientError::Answer { address: self.address(), path: path.to_owned(), answer })
    }

    /// Sends a request and reads the whole response, after which the server closes the connection.
    fn exchange(&self, path: &str) -> io::Result<Vec<u8>> {
        let address = self.address();
        let deadline = Instant::now() + EXCHANGE_TIMEOUT;
        let mut stream = connect(&address)?;
        stream.set_write_timeout(Some(STEP_TIMEOUT))?;
        let request = format!("GET {path} HTTP/1.1\r\nHost: {address}\r\nConnection: close\r\n\r\n");
        stream.write_all(request.as_bytes())?;
        let (mut response, mut buffer) = (Vec::new(), vec![0; 1 << 16]);
        while (response.len() as u64) < RESPONSE_BYTES_MAX {
            let left = deadline.saturating_duration_since(Instant::now());
            if left.is_zero() {
                return Err(io::ErrorKind::TimedOut.into());
            }
            stream.set_read_timeout(Some(left.min(STEP_TIMEOUT)))?;
            match stream.read(&mut buffer) {
                Ok(0) => break,
                Ok(read) => response.extend_from_slice(&buffer[..read]),
                Err(error) if error.kind() == io::ErrorKind::Interrupted => {}
                Err(error) => return Err(error),
            }
        }
        Ok(response)
    }
}

/// Connects to the first address of a host that accepts a connection.
fn connect(address: &str) -> io::Result<TcpStream> {
    let mut last = io::Error::from(io::ErrorKind::AddrNotAvailable);
    for found in address.to_socket_addrs()? {
        match TcpStream::connect_timeout(&found, STEP_TIMEOUT) {
            Ok(stream) => return Ok(stream),
            Err(error) => last = error,
        }
    }
    Err(last)
}

/// The complete body of a response with status 200; the error says what is wrong.
fn body(response: &[u8]) -> Result<&[u8], String> {
    let end = response.windows(4).position(|four| four == b"\r\n\r\n").ok_or("no HTTP header")?;
    let header = String::from_utf8_lossy(&response[..end]);
    let mut lines = header.lines();
    let first = lines.next().unwrap_or_default();
    if first.split(' ').nth(1) != Some("200") {
        return Err(first.to_owned());
    }
    let body = &response[end + 4..];
    let length: Option<usize> = lines.find_map(|line| {
        let (name, value) = line.split_once(':')?;
        name.eq_ignore_ascii_case("content-length").then(|| value.trim().parse().ok())?
    });
    match length {
        Some(length) if body.len() == length => Ok(body),
        Some(length) => Err(format!("{} of {length} bytes", body.len())),
        None => Err("no Content-Length".into()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_complete_responses_with_status_200_are_read() {
        let body = |text: &str| body(text.as_bytes()).map(<[u8]>::to_vec);
        assert_eq!(body("HTTP/1.1 200 OK\r\ncontent-length: 2\r\n\r\n{}").unwrap(), b"{}");
        for (answer, expected) in [
            ("", "no HTTP header"),
            ("HTTP/1.1 200 OK\r\nContent-Length: 2\r\n", "no HTTP header"),
            ("HTTP/1.1 200 OK\r\nContent-Length: 3\r\n\r\n{}", "2 of 3 bytes"),
            ("HTTP/1.1 200 OK\r\n\r\n{}", "no Content-Length"),
            (
                "HTTP/1.1 421 Misdirected Request\r\nContent-Length: 0\r\n\r\n",
                "HTTP/1.1 421 Misdirected Request",
            ),
            ("SSH-2.0\r\n\r\n", "SSH-2.0"),
        ] {
            assert_eq!(body(answer).unwrap_err(), expected, "{answer}");
        }
    }
}
