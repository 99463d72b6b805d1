//! Pages: single HTML files that need neither network nor scripts.

use diorama_data::photo;
use diorama_geom::ImageU8;

const STYLE: &str = "body{font:16px sans-serif;color:#222;background:#fff;max-width:72em;margin:2em auto;padding:0 1em}img{max-width:100%}\
td,th{padding:.2em 1em;text-align:left}pre{background:#eee;padding:1em;overflow:auto}";

/// A text without markup, for elements and quoted attributes.
pub fn escaped(text: &str) -> String {
    let mut out = String::with_capacity(text.len());
    for c in text.chars() {
        match c {
            '&' => out += "&amp;",
            '<' => out += "&lt;",
            '>' => out += "&gt;",
            '"' => out += "&quot;",
            '\'' => out += "&#39;",
            // HTML and XML know no other control characters.
            c if c.is_control() && !"\t\n\r".contains(c) => out.push('\u{fffd}'),
            c => out.push(c),
        }
    }
    out
}

/// A page; `title` is plain text, `style` has further rules, `body` is HTML.
pub fn page(title: &str, style: &str, body: &str) -> String {
    let title = escaped(title);
    format!(
        "<!doctype html>\n<html lang=\"en\"><head><meta charset=\"utf-8\"><meta name=\"viewport\" content=\"width=device-width\">\
<title>{title}</title>\n<style>{STYLE}{style}</style></head>\n<body>\n{body}</body></html>\n"
    )
}

/// The address of an image that stands in the page itself: a PNG in base64.
pub fn png_uri(image: &ImageU8) -> String {
    format!("data:image/png;base64,{}", base64(&photo::encode_png(image)))
}

/// Base64 with padding (RFC 4648).
fn base64(bytes: &[u8]) -> String {
    const DIGITS: &[u8; 64] = b"ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789+/";
    let mut out = String::with_capacity(bytes.len().div_ceil(3) * 4);
    for group in bytes.chunks(3) {
        let at = |k: usize| group.get(k).map_or(0, |b| *b as u32);
        let bits = (at(0) << 16) | (at(1) << 8) | at(2);
        for k in 0..4 {
            let digit = DIGITS[((bits >> (18 - 6 * k)) & 63) as usize] as char;
            out.push(if k <= group.len() { digit } else { '=' });
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn base64_gives_the_vectors_of_rfc_4648() {
        let pairs =
            [("", ""), ("f", "Zg=="), ("fo", "Zm8="), ("foo", "Zm9v"), ("foob", "Zm9vYg=="), ("fooba", "Zm9vYmE="), ("foobar", "Zm9vYmFy")];
        for (text, expected) in pairs {
            assert_eq!(base64(text.as_bytes()), expected);
        }
        assert_eq!(base64(&[0xfb, 0xff, 0xbf]), "+/+/");
    }

    #[test]
    fn no_text_is_markup() {
        assert_eq!(escaped("a<b & \"c\" 'd'>\u{1}"), "a&lt;b &amp; &quot;c&quot; &#39;d&#39;&gt;\u{fffd}");
        assert!(page("<script>", "", "<p>x</p>").contains("<title>&lt;script&gt;</title>"));
    }
}
