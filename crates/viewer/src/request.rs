//! Parses the head of an HTTP request and decides whether to answer it.

use std::io::Read;
use std::net::TcpStream;

/// Longest head that is read.
const LONGEST: usize = 16 << 10;

/// The parts of a request that are used here.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Request {
    pub path: String,
    pub token: Option<String>,
    pub host: Option<String>,
    pub origin: Option<String>,
    /// Key of a WebSocket handshake.
    pub socket_key: Option<String>,
}

/// Files of the page that contain no data of a run. Browsers request them without the token.
const WITHOUT_TOKEN: [&str; 3] = ["/app.js", "/app.css", "/favicon.ico"];

/// Why a request is refused: status and reason.
pub type Refusal = (u16, &'static str);

/// Reads the head of a request.
pub fn read(stream: &mut TcpStream) -> Result<Request, Refusal> {
    let mut data = Vec::new();
    let mut part = [0; 1024];
    loop {
        let n = stream.read(&mut part).map_err(|_| (408, "the request came too slowly"))?;
        if n == 0 {
            return Err((400, "the request ended too early"));
        }
        data.extend(&part[..n]);
        if data.windows(4).any(|w| w == b"\r\n\r\n") {
            return parse(&data);
        }
        if data.len() > LONGEST {
            return Err((431, "the request's head is too long"));
        }
    }
}

/// Parses the head of a request.
pub fn parse(data: &[u8]) -> Result<Request, Refusal> {
    let mut headers = [httparse::EMPTY_HEADER; 64];
    let mut r = httparse::Request::new(&mut headers);
    match r.parse(data) {
        Ok(httparse::Status::Complete(_)) => {}
        _ => return Err((400, "the request cannot be read")),
    }
    if r.method != Some("GET") {
        return Err((405, "only GET is supported"));
    }
    let target = r.path.unwrap_or("/");
    let (path, query) = target.split_once('?').unwrap_or((target, ""));
    let token = query.split('&').find_map(|p| p.strip_prefix("token=")).map(str::to_string);
    let mut out = Request { path: path.to_string(), token, ..Request::default() };
    let mut wants_socket = false;
    for h in r.headers.iter() {
        let Ok(value) = std::str::from_utf8(h.value) else { continue };
        let value = value.trim().to_string();
        let slot = match h.name.to_ascii_lowercase().as_str() {
            "host" => &mut out.host,
            "origin" => &mut out.origin,
            "sec-websocket-key" => &mut out.socket_key,
            "upgrade" => {
                wants_socket = value.eq_ignore_ascii_case("websocket");
                continue;
            }
            _ => continue,
        };
        // Duplicate headers are an attack.
        if slot.replace(value).is_some() {
            return Err((400, "a header appears twice"));
        }
    }
    if !wants_socket {
        out.socket_key = None;
    }
    Ok(out)
}

/// Whether a request comes from the page of this server.
pub fn admit(r: &Request, hosts: &[String], token: Option<&str>) -> Result<(), Refusal> {
    // A host name that resolves to this machine is not sufficient (DNS rebinding).
    if !r.host.as_ref().is_some_and(|h| hosts.contains(h)) {
        return Err((403, "wrong Host: open the address that diorama printed"));
    }
    let from_here = |o: &String| o.strip_prefix("http://").is_some_and(|h| hosts.iter().any(|known| known == h));
    if r.origin.as_ref().is_some_and(|o| !from_here(o)) || (r.socket_key.is_some() && r.origin.is_none()) {
        return Err((403, "wrong Origin: only diorama's own page is allowed"));
    }
    match (token, &r.token) {
        (None, _) => Ok(()),
        _ if WITHOUT_TOKEN.contains(&&r.path[..]) => Ok(()),
        (Some(t), Some(given)) if same(t.as_bytes(), given.as_bytes()) => Ok(()),
        _ => Err((401, "the token is missing or wrong: open the address that diorama printed")),
    }
}

/// Compares in a time that does not reveal the position of the first difference.
fn same(a: &[u8], b: &[u8]) -> bool {
    a.len() == b.len() && a.iter().zip(b).fold(0, |d, (a, b)| d | (a ^ b)) == 0
}

#[cfg(test)]
mod tests {
    use super::*;

    fn head(extra: &str) -> Vec<u8> {
        format!("GET /socket?token=abc HTTP/1.1\r\n{extra}\r\n").into_bytes()
    }

    const HERE: &str = "127.0.0.1:7007";

    fn verdict(extra: &str, token: Option<&str>) -> u16 {
        let admitted = parse(&head(extra)).and_then(|r| admit(&r, &[HERE.to_string(), "localhost:7007".into()], token));
        admitted.map_or_else(|e| e.0, |()| 200)
    }

    #[test]
    fn only_the_own_page_is_admitted() {
        let socket = "Upgrade: websocket\r\nSec-WebSocket-Key: k\r\n";
        let own = format!("Host: {HERE}\r\nOrigin: http://{HERE}\r\n{socket}");
        assert_eq!(verdict(&own, None), 200);
        assert_eq!(verdict(&format!("Host: {HERE}\r\n"), None), 200);
        assert_eq!(verdict("", None), 403, "no Host");
        assert_eq!(verdict("Host: evil.example:7007\r\n", None), 403, "rebinding");
        assert_eq!(verdict("Host: 127.0.0.1\r\n", None), 403, "no port");
        for origin in
            ["http://evil.example", "https://127.0.0.1:7007", "null", "http://127.0.0.1:7007.evil.example", "http://127.0.0.1:70070"]
        {
            assert_eq!(verdict(&format!("Host: {HERE}\r\nOrigin: {origin}\r\n{socket}"), None), 403, "{origin}");
        }
        assert_eq!(verdict(&format!("Host: {HERE}\r\n{socket}"), None), 403, "a socket without Origin");
        assert_eq!(verdict(&format!("Host: {HERE}\r\nHost: evil\r\n"), None), 400);
    }

    #[test]
    fn the_token_has_to_be_exact() {
        let own = format!("Host: {HERE}\r\nOrigin: http://{HERE}\r\n");
        assert_eq!(verdict(&own, Some("abc")), 200);
        assert_eq!(verdict(&own, Some("abd")), 401);
        assert_eq!(verdict(&own, Some("ab")), 401);
        for (path, status) in [("/app.js", 200), ("/app.css", 200), ("/", 401), ("/mesh.glb", 401), ("/camera_path.json", 401)] {
            let r = parse(format!("GET {path} HTTP/1.1\r\nHost: {HERE}\r\n\r\n").as_bytes()).unwrap();
            assert_eq!(admit(&r, &[HERE.into()], Some("abc")).map_or_else(|e| e.0, |()| 200), status, "{path}");
        }
    }

    #[test]
    fn other_methods_and_rubbish_are_refused() {
        assert_eq!(parse(b"POST / HTTP/1.1\r\n\r\n").unwrap_err().0, 405);
        assert_eq!(parse(b"\x16\x03\x01\r\n\r\n").unwrap_err().0, 400);
    }
}
