//! The pages of an E57 file: 1020 bytes of content and a CRC-32C each. `physical` offsets count the checksums, `logical` ones do not.
use crate::file_at::FileAt;

pub const PAGE_BYTES: u64 = 1024;
const CONTENT_BYTES: u64 = PAGE_BYTES - 4;
const PAGES_AT_ONCE: u64 = 256;

const fn make_tables() -> [[u32; 256]; 8] {
    let mut tables = [[0u32; 256]; 8];
    let mut i = 0;
    while i < 256 {
        let mut value = i as u32;
        let mut bit = 0;
        while bit < 8 {
            value = if value & 1 == 1 { (value >> 1) ^ 0x82f6_3b78 } else { value >> 1 };
            bit += 1;
        }
        tables[0][i] = value;
        i += 1;
    }
    let mut table = 1;
    while table < 8 {
        let mut i = 0;
        while i < 256 {
            let before = tables[table - 1][i];
            tables[table][i] = (before >> 8) ^ tables[0][(before & 0xff) as usize];
            i += 1;
        }
        table += 1;
    }
    tables
}
static TABLES: [[u32; 256]; 8] = make_tables();

/// CRC-32C (Castagnoli), eight bytes at a time.
pub fn crc32c(bytes: &[u8]) -> u32 {
    let mut crc = !0u32;
    let mut words = bytes.chunks_exact(8);
    for w in &mut words {
        let low = crc ^ u32::from_le_bytes([w[0], w[1], w[2], w[3]]);
        crc = TABLES[7][(low & 0xff) as usize]
            ^ TABLES[6][(low >> 8 & 0xff) as usize]
            ^ TABLES[5][(low >> 16 & 0xff) as usize]
            ^ TABLES[4][(low >> 24) as usize]
            ^ TABLES[3][w[4] as usize]
            ^ TABLES[2][w[5] as usize]
            ^ TABLES[1][w[6] as usize]
            ^ TABLES[0][w[7] as usize];
    }
    for byte in words.remainder() {
        crc = (crc >> 8) ^ TABLES[0][((crc ^ *byte as u32) & 0xff) as usize];
    }
    !crc
}

pub struct Pages {
    file: FileAt,
    pages: u64,
    buffer: Vec<u8>,    // logical bytes of whole pages
    buffer_offset: u64, // logical
    offset: u64,        // logical
    raw: Vec<u8>,
}

impl Pages {
    pub fn new(descriptor: i32, file_bytes: u64) -> Self {
        let file = FileAt::range(descriptor, 0, file_bytes);
        Self { file, pages: file_bytes / PAGE_BYTES, buffer: Vec::new(), buffer_offset: 0, offset: 0, raw: Vec::new() }
    }

    /// Where the next byte lies in the file.
    pub fn physical(&self) -> u64 {
        self.offset / CONTENT_BYTES * PAGE_BYTES + self.offset % CONTENT_BYTES
    }

    pub fn seek_physical(&mut self, physical: u64) -> Result<(), String> {
        if physical / PAGE_BYTES >= self.pages || physical % PAGE_BYTES >= CONTENT_BYTES {
            return Err(format!("offset {physical} lies outside the pages of the file"));
        }
        self.offset = physical / PAGE_BYTES * CONTENT_BYTES + physical % PAGE_BYTES;
        Ok(())
    }

    pub fn read(&mut self, to: &mut [u8]) -> Result<(), String> {
        let mut done = 0;
        while done < to.len() {
            let in_buffer = self.offset >= self.buffer_offset && self.offset < self.buffer_offset + self.buffer.len() as u64;
            if !in_buffer {
                self.load(self.offset / CONTENT_BYTES)?;
            }
            let at = (self.offset - self.buffer_offset) as usize;
            let count = (to.len() - done).min(self.buffer.len() - at);
            to[done..done + count].copy_from_slice(&self.buffer[at..at + count]);
            done += count;
            self.offset += count as u64;
        }
        Ok(())
    }

    fn load(&mut self, page: u64) -> Result<(), String> {
        if page >= self.pages {
            return Err(format!("offset {}: the file ends early", page * PAGE_BYTES));
        }
        let count = (self.pages - page).min(PAGES_AT_ONCE);
        self.raw.resize((count * PAGE_BYTES) as usize, 0);
        self.file.read_at(page * PAGE_BYTES, &mut self.raw).map_err(|error| format!("offset {}: {error}", page * PAGE_BYTES))?;
        self.buffer.clear();
        self.buffer_offset = page * CONTENT_BYTES;
        for (i, raw) in self.raw.chunks_exact(PAGE_BYTES as usize).enumerate() {
            let (content, sum) = raw.split_at(CONTENT_BYTES as usize);
            let found = u32::from_be_bytes([sum[0], sum[1], sum[2], sum[3]]); // the one big-endian number of the format
            let computed = crc32c(content);
            if found != computed {
                if i > 0 {
                    break; // the pages before it may be all that is wanted
                }
                return Err(format!("page {page} (offset {}): checksum {found:08x}, its content has {computed:08x}: the file is damaged", page * PAGE_BYTES));
            }
            self.buffer.extend_from_slice(content);
        }
        Ok(())
    }
}
