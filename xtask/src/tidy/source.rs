//! Parses Rust sources: strips comments and literals, and finds functions and the paths that they name.

/// A function with a body.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Function {
    pub name: String,
    /// Number of its first line, starting at 1.
    pub line: usize,
    /// Number of lines from `fn` to the closing brace.
    pub lines: usize,
}

/// The source with comments and the contents of strings and characters replaced by spaces; line numbers are unchanged.
pub fn code(text: &str) -> String {
    let t: Vec<char> = text.chars().collect();
    let mut out = String::with_capacity(text.len());
    let mut i = 0;
    while i < t.len() {
        let end = no_code(&t, i);
        if end == i {
            out.push(t[i]);
            i += 1;
            continue;
        }
        out.extend(t[i..end].iter().map(|c| if *c == '\n' { '\n' } else { ' ' }));
        i = end;
    }
    out
}

/// End of the comment or literal that starts at `i`; `i` if none starts there.
fn no_code(t: &[char], i: usize) -> usize {
    let at = |k: usize| t.get(k).copied().unwrap_or('\0');
    match (at(i), at(i + 1)) {
        ('/', '/') => (i..t.len()).find(|k| t[*k] == '\n').unwrap_or(t.len()),
        ('/', '*') => {
            let (mut depth, mut k) = (0, i);
            while k < t.len() {
                match (at(k), at(k + 1)) {
                    ('/', '*') => (depth, k) = (depth + 1, k + 2),
                    ('*', '/') if depth == 1 => return k + 2,
                    ('*', '/') => (depth, k) = (depth - 1, k + 2),
                    _ => k += 1,
                }
            }
            t.len()
        }
        ('"', _) => {
            let mut k = i + 1;
            while k < t.len() && t[k] != '"' {
                k += if t[k] == '\\' { 2 } else { 1 };
            }
            (k + 1).min(t.len())
        }
        ('r', '"' | '#') if i == 0 || !is_word(t[i - 1]) || at(i - 1) == 'b' => raw_string(t, i),
        ('\'', '\\') => (i + 3..t.len()).find(|k| t[*k] == '\'').map_or(t.len(), |k| k + 1),
        // Otherwise it is a lifetime.
        ('\'', _) if at(i + 2) == '\'' => i + 3,
        _ => i,
    }
}

fn raw_string(t: &[char], i: usize) -> usize {
    let hashes = t[i + 1..].iter().take_while(|c| **c == '#').count();
    let begin = i + 1 + hashes;
    // A raw identifier, such as r#type.
    if t.get(begin) != Some(&'"') {
        return i;
    }
    let closes = |k: usize| t[k] == '"' && t[k + 1..].iter().take_while(|c| **c == '#').count() >= hashes;
    (begin + 1..t.len()).find(|k| closes(*k)).map_or(t.len(), |k| k + 1 + hashes)
}

fn is_word(c: char) -> bool {
    c.is_alphanumeric() || c == '_'
}

/// All functions with a body, in code without comments and literals.
pub fn functions(code: &str) -> Vec<Function> {
    let mut found = Vec::new();
    for (at, _) in code.match_indices("fn ") {
        let is_whole = !code[..at].ends_with(is_word);
        let rest = &code[at + 3..];
        let name: String = rest.trim_start().chars().take_while(|c| is_word(*c)).collect();
        if let Some(length) = body_end(rest).filter(|_| is_whole && !name.is_empty()) {
            let lines = 1 + rest[..length].matches('\n').count();
            found.push(Function { name, line: 1 + code[..at].matches('\n').count(), lines });
        }
    }
    found
}

/// End of the body of a function whose signature starts `rest`; `None` for a declaration.
fn body_end(rest: &str) -> Option<usize> {
    let mut depth = 0;
    for (i, c) in rest.char_indices() {
        match c {
            '(' | '[' => depth += 1,
            ')' | ']' => depth -= 1,
            ';' | '}' if depth == 0 => return None,
            '{' if depth == 0 => return block_end(rest, i),
            _ => {}
        }
    }
    None
}

/// End of the block that opens at `from`.
fn block_end(code: &str, from: usize) -> Option<usize> {
    let mut depth = 0;
    for (i, c) in code[from..].char_indices() {
        match c {
            '{' => depth += 1,
            '}' if depth == 1 => return Some(from + i + 1),
            '}' => depth -= 1,
            _ => {}
        }
    }
    None
}

/// Code without items that exist only for tests.
pub fn without_tests(code: &str) -> String {
    let mut out = code.to_string();
    let marks = ["#[cfg(test)]", "#[cfg(all(test,"];
    while let Some(at) = marks.iter().filter_map(|m| out.find(m)).min() {
        let item = at + out[at..].find(']').map_or(1, |i| i + 1);
        let end = match out[item..].find([';', '{']).map(|i| item + i) {
            Some(i) if out[i..].starts_with('{') => block_end(&out, i).unwrap_or(out.len()),
            Some(i) => i + 1,
            None => out.len(),
        };
        let blank: String = out[at..end].chars().map(|c| if c == '\n' { '\n' } else { ' ' }).collect();
        out.replace_range(at..end, &blank);
    }
    out
}

/// All paths that start with `crate`, `self` or `super`, in `use` items (with their braces expanded) and elsewhere, with their line
/// numbers.
pub fn paths(code: &str) -> Vec<(usize, Vec<String>)> {
    let mut found = Vec::new();
    let mut rest = 0;
    while let Some((at, word)) = next_root(code, rest) {
        let line = 1 + code[..at].matches('\n').count();
        let mut tree = Vec::new();
        spread(&code[at..], &mut Vec::new(), &mut tree);
        found.extend(tree.into_iter().map(|path| (line, path)));
        rest = at + word;
    }
    found
}

/// Start of the next path, and the length of its first word.
fn next_root(code: &str, from: usize) -> Option<(usize, usize)> {
    let roots = ["crate::", "self::", "super::"];
    let begins = |at: usize| !code[..at].ends_with(|c: char| is_word(c) || c == ':' || c == '$');
    let next = |root: &str| code[from..].match_indices(root).map(|(i, _)| from + i).find(|at| begins(*at)).map(|at| (at, root.len()));
    roots.iter().filter_map(|r| next(r)).min()
}

/// Parses one tree of paths at the start of `text`; returns its length.
fn spread(text: &str, prefix: &mut Vec<String>, out: &mut Vec<Vec<String>>) -> usize {
    let depth = prefix.len();
    let mut i = 0;
    loop {
        i += text[i..].len() - text[i..].trim_start().len();
        if text[i..].starts_with('{') {
            i += 1;
            while i < text.len() && !text[i..].trim_start().starts_with('}') {
                i += spread(&text[i..], prefix, out);
                i += text[i..].find([',', '}']).map_or(text.len() - i, |k| if text[i + k..].starts_with(',') { k + 1 } else { k });
            }
            i += text[i..].find('}').map_or(text.len() - i, |k| k + 1);
            break;
        }
        let word: String = text[i..].chars().take_while(|c| is_word(*c)).collect();
        if word.is_empty() {
            out.push(prefix.clone());
            break;
        }
        i += word.len();
        prefix.push(word);
        if !text[i..].starts_with("::") {
            out.push(prefix.clone());
            break;
        }
        i += 2;
    }
    prefix.truncate(depth);
    i
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn comments_and_literals_are_no_code() {
        let text = "a /* fn b() { /* { */ */ c \"}\\\"{\" 'x' '\\'' '{' &'a str r#\"fn \" {\"# b'}' // }\nd";
        let clean = code(text);
        assert!(!clean.contains(['{', '}', '"']) && clean.contains("&'a str") && clean.ends_with("\nd"), "{clean}");
        assert_eq!(code("r#type \"\\u{7d}\" '\\u{7d}' e").split_whitespace().collect::<Vec<_>>(), ["r#type", "e"]);
    }

    #[test]
    fn functions_have_their_lengths() {
        let text =
            "trait T {\n    fn a(&self) -> [u8; 3];\n    fn b(&self) {\n        // }\n    }\n}\nfn c() -> u8 { 1 }\nlet f: fn (u8);\n";
        let found: Vec<_> = functions(&code(text)).into_iter().map(|f| (f.name, f.line, f.lines)).collect();
        assert_eq!(found, [("b".into(), 3, 3), ("c".into(), 7, 1)]);
    }

    #[test]
    fn tests_are_left_out() {
        let text = "use a;\n#[cfg(test)]\nuse b;\nfn c() {}\n#[cfg(test)]\nmod tests {\n    fn d() { e() }\n}\nfn f() {}\n";
        assert_eq!(without_tests(text).split_whitespace().collect::<Vec<_>>(), ["use", "a;", "fn", "c()", "{}", "fn", "f()", "{}"]);
    }

    #[test]
    fn paths_are_spread_out() {
        let text = "use crate::{a::b, c::{self, d as e}};\nuse super::super::f::*;\nlet x = crate::g::H { i: not_super::j };\n$crate::k();";
        let found: Vec<_> = paths(text).into_iter().map(|(line, p)| format!("{line} {}", p.join("::"))).collect();
        assert_eq!(found, ["1 crate::a::b", "1 crate::c::self", "1 crate::c::d", "2 super::super::f", "3 crate::g::H"]);
    }
}
