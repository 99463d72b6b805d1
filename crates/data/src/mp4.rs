//! H.264 video in an MP4 file, encoded by openh264, so that no ffmpeg is needed.

use crate::atomic;
use crate::error::{DataError, Result};
use diorama_geom::ImageU8;
use openh264::encoder::{BitRate, Encoder, EncoderConfig, FrameRate, RateControlMode};
use openh264::formats::{RgbSliceU8, YUVBuffer};
use std::path::{Path, PathBuf};

/// A video being written; no file appears before [`Video::finish`].
pub struct Video {
    path: PathBuf,
    encoder: Encoder,
    fps: u32,
    size: (usize, usize),
    sps: Vec<u8>,
    pps: Vec<u8>,
    /// Sample data; and for each sample its length and whether it is a key frame.
    data: Vec<u8>,
    samples: Vec<(u32, bool)>,
}

impl Video {
    /// Starts a video with frames of one size, which is reduced to even numbers.
    pub fn create(path: &Path, width: usize, height: usize, fps: u32) -> Result<Video> {
        let size = (width & !1, height & !1);
        if size.0 < 16 || size.1 < 16 || size.0 > 3840 || size.1 > 2160 {
            return Err(DataError::input(
                path,
                format!("video of {width}×{height}: the encoder accepts 16×16 to 3840×2160; choose another --size"),
            ));
        }
        let rate = (size.0 * size.1) as f64 * fps as f64 * 0.25;
        let config = EncoderConfig::new()
            .bitrate(BitRate::from_bps(rate as u32))
            .max_frame_rate(FrameRate::from_hz(fps as f32))
            .rate_control_mode(RateControlMode::Off)
            .skip_frames(false);
        let api = openh264::OpenH264API::from_source();
        let encoder = Encoder::with_api_config(api, config)
            .map_err(|e| DataError::input(path, format!("the video encoder could not be started: {e}")))?;
        Ok(Video { path: path.to_path_buf(), encoder, fps, size, sps: vec![], pps: vec![], data: vec![], samples: vec![] })
    }

    /// Adds a frame `[H, W, 3]`.
    pub fn push(&mut self, frame: &ImageU8) -> Result<()> {
        let (w, h) = self.size;
        let rgb: Vec<u8> = (0..h).flat_map(|y| &frame.data[y * frame.width * 3..][..w * 3]).copied().collect();
        let yuv = YUVBuffer::from_rgb8_source(RgbSliceU8::new(&rgb, (w, h)));
        let failed = |e: openh264::Error| DataError::input(&self.path, format!("the video encoder failed: {e}"));
        let stream = self.encoder.encode(&yuv).map_err(failed)?.to_vec();
        let (start, mut key) = (self.data.len(), false);
        for nal in nal_units(&stream) {
            match nal[0] & 31 {
                7 => self.sps = nal.to_vec(),
                8 => self.pps = nal.to_vec(),
                kind => {
                    key |= kind == 5;
                    self.data.extend((nal.len() as u32).to_be_bytes());
                    self.data.extend(nal);
                }
            }
        }
        self.samples.push(((self.data.len() - start) as u32, key));
        Ok(())
    }

    /// Writes the file.
    pub fn finish(self) -> Result<()> {
        if self.samples.is_empty() || self.sps.is_empty() {
            return Err(DataError::input(&self.path, "a video needs at least one frame"));
        }
        let ftyp = atom(b"ftyp", &[b"isom", &0u32.to_be_bytes()[..], b"isomavc1"].concat());
        // The offset of the samples depends only on the sizes of the parts before them.
        let moov_size = self.moov(0).len();
        let offset = (ftyp.len() + moov_size + 8) as u32;
        let out = [ftyp, self.moov(offset), atom(b"mdat", &self.data)].concat();
        atomic::write(&self.path, &out)
    }

    fn moov(&self, offset: u32) -> Vec<u8> {
        let (w, h) = (self.size.0 as u32, self.size.1 as u32);
        let n = self.samples.len() as u32;
        let timescale = self.fps * 1000;
        let duration = n * 1000;
        let mvhd = full(
            b"mvhd",
            0,
            &[&words(&[0, 0, timescale, duration, 0x10000, 0x0100_0000, 0, 0])[..], &matrix(), &words(&[0; 6]), &words(&[2])].concat(),
        );
        let tkhd = full(b"tkhd", 3, &[&words(&[0, 0, 1, 0, duration, 0, 0, 0, 0])[..], &matrix(), &words(&[w << 16, h << 16])].concat());
        let mdhd = full(b"mdhd", 0, &words(&[0, 0, timescale, duration, 0x55c4_0000]));
        let hdlr = full(b"hdlr", 0, &[&words(&[0])[..], b"vide", &words(&[0; 3]), b"video\0"].concat());
        let avcc = [&[1, self.sps[1], self.sps[2], self.sps[3], 0xff, 0xe1][..], &sized(&self.sps), &[1], &sized(&self.pps)].concat();
        let avc1 = atom(
            b"avc1",
            &[
                &[0, 0, 0, 0, 0, 0, 0, 1][..],
                &words(&[0; 4]),
                &[(w >> 8) as u8, w as u8, (h >> 8) as u8, h as u8],
                &words(&[0x0048_0000, 0x0048_0000, 0]),
                &[0, 1],
                &[0; 32],
                &[0, 24, 255, 255],
                &atom(b"avcC", &avcc),
            ]
            .concat(),
        );
        let stsd = full(b"stsd", 0, &[&words(&[1])[..], &avc1].concat());
        let stts = full(b"stts", 0, &words(&[1, n, 1000]));
        let keys: Vec<u32> = (1..=n).filter(|i| self.samples[*i as usize - 1].1).collect();
        let stss = full(b"stss", 0, &words(&[&[keys.len() as u32][..], &keys].concat()));
        let stsc = full(b"stsc", 0, &words(&[1, 1, n, 1]));
        let sizes: Vec<u32> = self.samples.iter().map(|s| s.0).collect();
        let stsz = full(b"stsz", 0, &words(&[&[0, n][..], &sizes].concat()));
        let stco = full(b"stco", 0, &words(&[1, offset]));
        let stbl = atom(b"stbl", &[stsd, stts, stss, stsc, stsz, stco].concat());
        let vmhd = full(b"vmhd", 1, &words(&[0, 0]));
        let dref = full(b"dref", 0, &[&words(&[1])[..], &full(b"url ", 1, &[])].concat());
        let minf = atom(b"minf", &[vmhd, atom(b"dinf", &dref), stbl].concat());
        let mdia = atom(b"mdia", &[mdhd, hdlr, minf].concat());
        let trak = atom(b"trak", &[tkhd, mdia].concat());
        atom(b"moov", &[mvhd, trak].concat())
    }
}

fn words(v: &[u32]) -> Vec<u8> {
    v.iter().flat_map(|w| w.to_be_bytes()).collect()
}

fn matrix() -> Vec<u8> {
    words(&[0x10000, 0, 0, 0, 0x10000, 0, 0, 0, 0x4000_0000])
}

fn atom(kind: &[u8; 4], body: &[u8]) -> Vec<u8> {
    [&(body.len() as u32 + 8).to_be_bytes()[..], kind, body].concat()
}

fn full(kind: &[u8; 4], flags: u32, body: &[u8]) -> Vec<u8> {
    atom(kind, &[&flags.to_be_bytes()[..], body].concat())
}

fn sized(nal: &[u8]) -> Vec<u8> {
    [&(nal.len() as u16).to_be_bytes()[..], nal].concat()
}

/// NAL units of an Annex B stream, without their start codes.
fn nal_units(stream: &[u8]) -> Vec<&[u8]> {
    let mut starts = Vec::new();
    let mut i = 0;
    while i + 3 <= stream.len() {
        if stream[i..i + 3] == [0, 0, 1] {
            starts.push((i, i + 3));
            i += 3;
        } else {
            i += 1;
        }
    }
    let ends = starts.iter().skip(1).map(|s| s.0).chain([stream.len()]);
    starts
        .iter()
        .zip(ends)
        .map(|(&(_, a), b)| {
            let unit = &stream[a..b];
            // The fourth byte of a long start code, and trailing zeros, belong to no unit.
            &unit[..unit.iter().rposition(|v| *v != 0).map_or(0, |p| p + 1)]
        })
        .filter(|u| !u.is_empty())
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_video_has_its_atoms_and_as_many_samples_as_frames() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("v.mp4");
        let mut v = Video::create(&path, 65, 48, 24).unwrap();
        for i in 0..5u8 {
            v.push(&ImageU8 { width: 65, height: 48, channels: 3, data: vec![i * 50; 65 * 48 * 3] }).unwrap();
        }
        assert!(!path.exists());
        v.finish().unwrap();
        let data = std::fs::read(&path).unwrap();
        let mut at = 0;
        let mut kinds = vec![];
        while at < data.len() {
            let n = u32::from_be_bytes(data[at..at + 4].try_into().unwrap()) as usize;
            kinds.push(String::from_utf8_lossy(&data[at + 4..at + 8]).into_owned());
            at += n;
        }
        assert_eq!((kinds.join(" "), at), ("ftyp moov mdat".to_string(), data.len()));
        let stsz = data.windows(4).position(|w| w == b"stsz").unwrap();
        assert_eq!(u32::from_be_bytes(data[stsz + 12..stsz + 16].try_into().unwrap()), 5);
    }

    #[test]
    fn start_codes_of_both_lengths_are_cut() {
        let s = [0, 0, 0, 1, 0x67, 9, 0, 0, 1, 0x68, 8, 0, 0, 0, 1, 0x65, 7];
        assert_eq!(nal_units(&s), [&[0x67, 9][..], &[0x68, 8], &[0x65, 7]]);
    }
}
