//! URIs of buffers and images (RFC 3986): percent-encoded paths, and `data:` with base64 (RFC 4648).

/// Bytes of a `data:` URI; `None` for other URIs, an error for one that is damaged.
pub fn decode(uri: &str) -> Option<Result<Vec<u8>, &'static str>> {
    let rest = uri.strip_prefix("data:")?;
    let Some((head, body)) = rest.split_once(',') else { return Some(Err("the data URI has no comma before its data")) };
    Some(if head.ends_with(";base64") { base64(body).ok_or("the data URI is not base64") } else { Ok(percent_decoded(body)) })
}

/// A relative path of a URI.
pub fn path(uri: &str) -> Option<String> {
    String::from_utf8(percent_decoded(uri)).ok()
}

fn percent_decoded(text: &str) -> Vec<u8> {
    let bytes = text.as_bytes();
    let mut out = Vec::with_capacity(bytes.len());
    let mut i = 0;
    while i < bytes.len() {
        let digit = |k: usize| bytes.get(k).and_then(|b| (*b as char).to_digit(16));
        match (bytes[i], digit(i + 1), digit(i + 2)) {
            (b'%', Some(high), Some(low)) => {
                out.push((high * 16 + low) as u8);
                i += 3;
            }
            (b, ..) => {
                out.push(b);
                i += 1;
            }
        }
    }
    out
}

fn base64(text: &str) -> Option<Vec<u8>> {
    let text = text.trim_end_matches('=').as_bytes();
    let mut out = Vec::with_capacity(text.len() / 4 * 3);
    for group in text.chunks(4) {
        let mut word = 0u32;
        for b in group {
            let value = match b {
                b'A'..=b'Z' => b - b'A',
                b'a'..=b'z' => b - b'a' + 26,
                b'0'..=b'9' => b - b'0' + 52,
                b'+' => 62,
                b'/' => 63,
                _ => return None,
            };
            word = word << 6 | value as u32;
        }
        word <<= 6 * (4 - group.len());
        // Two characters hold one byte, three hold two; a single one holds none.
        out.extend(&word.to_be_bytes()[1..group.len().max(2)]);
        if group.len() == 1 {
            return None;
        }
    }
    Some(out)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn base64_gives_the_vectors_of_rfc_4648() {
        let vectors =
            [("", ""), ("Zg==", "f"), ("Zm8=", "fo"), ("Zm9v", "foo"), ("Zm9vYg==", "foob"), ("Zm9vYmE=", "fooba"), ("Zm9vYmFy", "foobar")];
        for (text, bytes) in vectors {
            assert_eq!(decode(&format!("data:application/octet-stream;base64,{text}")), Some(Ok(bytes.into())), "{text}");
        }
        assert!(decode("data:;base64,Zm9v!").unwrap().is_err() && decode("data:;base64,Zm9vY").unwrap().is_err());
        assert!(decode("data:nothing").unwrap().is_err());
    }

    #[test]
    fn paths_and_plain_data_are_percent_decoded() {
        assert_eq!(path("a%20b%C3%BC.png").as_deref(), Some("a bü.png"));
        assert_eq!(path("50%.png").as_deref(), Some("50%.png"));
        assert_eq!(decode("data:,a%20b"), Some(Ok(b"a b".to_vec())));
        assert_eq!(decode("scene.bin"), None);
    }
}
