//! A file that C++ has open, read at positions: nobody moves anybody's cursor, so several readers share one descriptor.
use std::fs::File;
use std::io::{Error, ErrorKind, Read, Result, Seek, SeekFrom};
use std::mem::ManuallyDrop;
use std::os::fd::FromRawFd;
use std::os::unix::fs::FileExt;

pub struct FileAt {
    file: ManuallyDrop<File>, // the descriptor stays C++'s
    begin: u64,
    end: u64,
    offset: u64,
}

impl FileAt {
    /// The bytes [begin, end) of the file, as a stream that starts at `begin`.
    pub fn range(descriptor: i32, begin: u64, end: u64) -> Self {
        let file = ManuallyDrop::new(unsafe { File::from_raw_fd(descriptor) });
        Self { file, begin, end, offset: begin }
    }

    /// Exactly the bytes asked for.
    pub fn read_at(&self, offset: u64, to: &mut [u8]) -> Result<()> {
        if offset > self.end || to.len() as u64 > self.end - offset {
            return Err(Error::new(ErrorKind::UnexpectedEof, format!("{} bytes at offset {offset} lie beyond {}", to.len(), self.end)));
        }
        self.file.read_exact_at(to, offset)
    }
}

impl Read for FileAt {
    fn read(&mut self, to: &mut [u8]) -> Result<usize> {
        let left = self.end.saturating_sub(self.offset).min(to.len() as u64) as usize;
        let got = self.file.read_at(&mut to[..left], self.offset)?;
        self.offset += got as u64;
        Ok(got)
    }
}

impl Seek for FileAt {
    fn seek(&mut self, to: SeekFrom) -> Result<u64> {
        let target = match to {
            SeekFrom::Start(n) => self.begin as i128 + n as i128,
            SeekFrom::Current(n) => self.offset as i128 + n as i128,
            SeekFrom::End(n) => self.end as i128 + n as i128,
        };
        if target < self.begin as i128 || target > i64::MAX as i128 {
            return Err(Error::new(ErrorKind::InvalidInput, format!("cannot go to byte {target}")));
        }
        self.offset = target as u64;
        Ok(self.offset - self.begin)
    }
}

/// A FileAt with a buffer, quick for the byte-wise reads of the arithmetic decoder.
pub struct Buffered {
    file: FileAt,
    buffer: Vec<u8>,
    at: usize,
}

const BUFFER_BYTES: usize = 1 << 16;

impl Buffered {
    pub fn new(file: FileAt) -> Self {
        Self { file, buffer: Vec::new(), at: 0 }
    }

    #[cold]
    fn refill(&mut self) -> Result<()> {
        self.buffer.resize(BUFFER_BYTES, 0);
        self.at = 0;
        let got = self.file.read(&mut self.buffer);
        self.buffer.truncate(*got.as_ref().unwrap_or(&0));
        if got? == 0 {
            return Err(Error::new(ErrorKind::UnexpectedEof, "the compressed data end early"));
        }
        Ok(())
    }
}

impl Read for Buffered {
    #[inline]
    fn read(&mut self, to: &mut [u8]) -> Result<usize> {
        if self.at == self.buffer.len() {
            if to.len() >= BUFFER_BYTES {
                return self.file.read(to);
            }
            match self.refill() {
                Ok(()) => {}
                Err(error) if error.kind() == ErrorKind::UnexpectedEof => return Ok(0),
                Err(error) => return Err(error),
            }
        }
        let count = to.len().min(self.buffer.len() - self.at);
        to[..count].copy_from_slice(&self.buffer[self.at..self.at + count]);
        self.at += count;
        Ok(count)
    }

    #[inline]
    fn read_exact(&mut self, to: &mut [u8]) -> Result<()> {
        if to.len() == 1 {
            if self.at == self.buffer.len() {
                self.refill()?;
            }
            to[0] = self.buffer[self.at];
            self.at += 1;
            return Ok(());
        }
        let mut done = 0;
        while done < to.len() {
            match self.read(&mut to[done..])? {
                0 => return Err(Error::new(ErrorKind::UnexpectedEof, "the compressed data end early")),
                got => done += got,
            }
        }
        Ok(())
    }
}

impl Seek for Buffered {
    fn seek(&mut self, to: SeekFrom) -> Result<u64> {
        let ahead = (self.buffer.len() - self.at) as i64;
        self.buffer.clear();
        self.at = 0;
        match to {
            SeekFrom::Current(n) => self.file.seek(SeekFrom::Current(n.saturating_sub(ahead))),
            other => self.file.seek(other),
        }
    }
}
