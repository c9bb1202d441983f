//! Reads what a server tells, over a plain socket: enough of HTTP for our own answers.

use std::io::{self, Read, Write};
use std::net::{TcpStream, ToSocketAddrs};
use std::time::{Duration, Instant};

use thiserror::Error;

use super::address::ServeAddress;

/// Longest wait for a connection, and for the next bytes of an answer.
const PATIENCE: Duration = Duration::from_secs(5);

/// Longest time for a whole exchange.
const WHOLE_TIME: Duration = Duration::from_secs(10);

/// Longest answer, bytes. A status of 1000 channels has some 1 MB.
const ANSWER_BYTES_MAX: u64 = 64 << 20;

/// Why there is no answer.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum ClientError {
    /// Nobody is there, or the connection broke.
    #[error("cannot read http://{address}{path}; expected a command that runs with --serve {address}")]
    Connection {
        /// The server.
        address: String,
        /// What was asked for.
        path: String,
        /// What the system says.
        source: io::Error,
    },
    /// An answer of another kind.
    #[error("http://{address}{path} answered `{answer}`; expected 200 and the JSON of a lunarray server")]
    Answer {
        /// The server.
        address: String,
        /// What was asked for.
        path: String,
        /// Its first line, or what is wrong with it.
        answer: String,
    },
}

/// Asks a server, once a connection.
#[derive(Clone, Debug)]
pub struct Client {
    address: ServeAddress,
}

impl Client {
    /// A client of the server at this address.
    #[must_use]
    pub fn new(address: ServeAddress) -> Self {
        Self { address }
    }

    /// The server's address.
    #[must_use]
    pub fn address(&self) -> String {
        self.address.to_string()
    }

    /// The JSON at a path such as `/api/status`.
    ///
    /// # Errors
    /// [`ClientError`]: no connection, no answer within seconds, or one that is not 200 with JSON.
    pub fn json(&self, path: &str) -> Result<serde_json::Value, ClientError> {
        let answer = self.exchange(path).map_err(|source| ClientError::Connection {
            address: self.address(),
            path: path.to_owned(),
            source,
        })?;
        body_of(&answer)
            .and_then(|body| serde_json::from_slice(body).map_err(|error| error.to_string()))
            .map_err(|answer| ClientError::Answer { address: self.address(), path: path.to_owned(), answer })
    }

    /// The whole answer. The server closes after it.
    fn exchange(&self, path: &str) -> io::Result<Vec<u8>> {
        let address = self.address();
        // All of it takes no longer than that, however slowly the answer comes.
        let until = Instant::now() + WHOLE_TIME;
        let mut stream = connect(&address)?;
        stream.set_write_timeout(Some(PATIENCE))?;
        let request = format!("GET {path} HTTP/1.1\r\nHost: {address}\r\nConnection: close\r\n\r\n");
        stream.write_all(request.as_bytes())?;
        let (mut answer, mut piece) = (Vec::new(), vec![0; 1 << 16]);
        while (answer.len() as u64) < ANSWER_BYTES_MAX {
            let left = until.saturating_duration_since(Instant::now());
            if left.is_zero() {
                return Err(io::ErrorKind::TimedOut.into());
            }
            stream.set_read_timeout(Some(left.min(PATIENCE)))?;
            match stream.read(&mut piece) {
                Ok(0) => break,
                Ok(read) => answer.extend_from_slice(&piece[..read]),
                Err(error) if error.kind() == io::ErrorKind::Interrupted => {}
                Err(error) => return Err(error),
            }
        }
        Ok(answer)
    }
}

/// Connects to the first of the addresses that answers.
fn connect(address: &str) -> io::Result<TcpStream> {
    let mut last = io::Error::from(io::ErrorKind::AddrNotAvailable);
    for found in address.to_socket_addrs()? {
        match TcpStream::connect_timeout(&found, PATIENCE) {
            Ok(stream) => return Ok(stream),
            Err(error) => last = error,
        }
    }
    Err(last)
}

/// The complete body of an answer 200, or what is wrong.
fn body_of(answer: &[u8]) -> Result<&[u8], String> {
    let end = answer.windows(4).position(|four| four == b"\r\n\r\n").ok_or("no HTTP header")?;
    let header = String::from_utf8_lossy(&answer[..end]);
    let mut lines = header.lines();
    let first = lines.next().unwrap_or_default();
    if first.split(' ').nth(1) != Some("200") {
        return Err(first.to_owned());
    }
    let body = &answer[end + 4..];
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
    fn only_whole_answers_of_200_are_read() {
        let body = |text: &str| body_of(text.as_bytes()).map(<[u8]>::to_vec);
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
