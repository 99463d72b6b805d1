//! The encoding of Protocol Buffers: fields of a number, each a variable-length integer, four bytes, or a length and bytes.

/// How a field's value is written.
const VARINT: u64 = 0;
const BYTES: u64 = 2;
const FOUR_BYTES: u64 = 5;

/// An encoded message.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Message(Vec<u8>);

impl Message {
    fn varint(&mut self, mut v: u64) {
        while v >= 0x80 {
            self.0.push(v as u8 | 0x80);
            v >>= 7;
        }
        self.0.push(v as u8);
    }

    fn key(&mut self, field: u64, kind: u64) {
        self.varint(field << 3 | kind);
    }

    pub fn integer(&mut self, field: u64, v: u64) {
        self.key(field, VARINT);
        self.varint(v);
    }

    pub fn float(&mut self, field: u64, v: f32) {
        self.key(field, FOUR_BYTES);
        self.0.extend(v.to_le_bytes());
    }

    pub fn bytes(&mut self, field: u64, v: &[u8]) {
        self.key(field, BYTES);
        self.varint(v.len() as u64);
        self.0.extend(v);
    }

    pub fn text(&mut self, field: u64, v: &str) {
        self.bytes(field, v.as_bytes());
    }

    pub fn message(&mut self, field: u64, v: &Message) {
        self.bytes(field, &v.0);
    }

    pub fn into_bytes(self) -> Vec<u8> {
        self.0
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn fields_are_encoded_as_the_format_says() {
        let mut m = Message::default();
        // The example of the format's own description: field 1 is 150.
        m.integer(1, 150);
        assert_eq!(m.0, [0x08, 0x96, 0x01]);
        let mut outer = Message::default();
        outer.message(3, &m);
        outer.text(2, "testing");
        outer.float(20, 1.0);
        let expected = [&[0x1a, 3, 8, 0x96, 1, 0x12, 7][..], b"testing", &[0xa5, 1, 0, 0, 0x80, 0x3f]].concat();
        assert_eq!(outer.into_bytes(), expected);
    }
}
