//! The chunks of a LAZ file: where they lie, and a decoder for each. Chunks are independent, so any number is decoded at once.
//! What the crate would believe is checked before it sees it: it allocates by counts and sizes from the file.
use crate::file_at::{Buffered, FileAt};
use laz::laszip::ChunkTable;
use laz::record::{LayeredPointRecordDecompressor, RecordDecompressor, SequentialPointRecordDecompressor};
use laz::{DecompressionSelection, LazItem, LazItemType, LazVlr};

pub struct Input<'a> {
    pub descriptor: i32,
    pub file_bytes: u64,
    pub point_offset: u64,
    pub count: u64,
    pub record_bytes: usize,
    pub point_format: u8,
    pub vlr: &'a [u8],
}

#[derive(Clone, Copy)]
pub struct Chunk {
    pub points: u64,
    pub offset: u64,
    pub bytes: u64,
}

pub struct Laz {
    descriptor: i32,
    record_bytes: usize,
    layered: bool,
    items: Vec<LazItem>,
    pub chunks: Vec<Chunk>,
}

// A byte of compressed data stands for some hundred points at most, where all are alike; far beyond that a chunk's count is made up.
const MOST_POINTS_PER_BYTE: u64 = 65536;

// Compressors; 2 is like 3 without layers.
const POINT_WISE: u16 = 1;
const LAYERED_CHUNKED: u16 = 3;

fn le_u16(bytes: &[u8], at: usize) -> u16 {
    u16::from_le_bytes([bytes[at], bytes[at + 1]])
}

/// Bytes of an item in a record, by its type in the file; None for an unknown type.
fn item_bytes(kind: u16, declared: u16) -> Option<u16> {
    Some(match kind {
        0 | 14 => declared,
        6 => 20,
        7 => 8,
        8 | 11 => 6,
        9 | 13 => 29,
        10 => 30,
        12 => 8,
        _ => return None,
    })
}

/// The record that says how the points are packed, checked in full. Returns the compressor too, which the crate does not show.
fn parse_vlr(input: &Input) -> Result<(LazVlr, u16), String> {
    let vlr = input.vlr;
    const FIXED: usize = 34;
    if vlr.len() < FIXED {
        return Err(format!("the laszip record has {} bytes, expected {FIXED} or more", vlr.len()));
    }
    let compressor = le_u16(vlr, 0);
    if !(POINT_WISE..=LAYERED_CHUNKED).contains(&compressor) {
        return Err(format!("laszip compressor {compressor}, expected 1 to 3"));
    }
    if le_u16(vlr, 2) != 0 {
        return Err(format!("laszip coder {}, expected 0 (arithmetic)", le_u16(vlr, 2)));
    }
    let num_items = le_u16(vlr, 32) as usize;
    if num_items == 0 || vlr.len() < FIXED + 6 * num_items {
        return Err(format!("the laszip record declares {num_items} items in {} bytes", vlr.len() - FIXED));
    }
    let mut sum = 0usize;
    for i in 0..num_items {
        let at = FIXED + 6 * i;
        let (kind, bytes, version) = (le_u16(vlr, at), le_u16(vlr, at + 2), le_u16(vlr, at + 4));
        let layered = compressor == LAYERED_CHUNKED;
        let versions = if layered { 3..=4 } else { 1..=2 };
        let kinds = if layered { 10..=14 } else { 0..=9 };
        if item_bytes(kind, bytes) != Some(bytes) || bytes == 0 || !versions.contains(&version) || !kinds.contains(&kind) {
            return Err(format!("laszip item {} of {num_items} has type {kind}, {bytes} bytes and version {version}, which do not belong together", i + 1));
        }
        let wanted = if input.point_format < 6 { 6 } else { 10 };
        if (i == 0) != (kind == wanted) {
            return Err(format!("laszip item {} of {num_items} has type {kind}, which does not fit point format {}", i + 1, input.point_format));
        }
        sum += bytes as usize;
    }
    if sum != input.record_bytes {
        return Err(format!("laszip items of {sum} bytes, the header declares records of {}", input.record_bytes));
    }
    let vlr = LazVlr::from_buffer(vlr).map_err(|error| format!("laszip record: {error}"))?;
    Ok((vlr, compressor))
}

/// (offset of the table, where the points start)
fn table_offset(file: &FileAt, input: &Input) -> Result<u64, String> {
    let mut bytes = [0u8; 8];
    let first = input.point_offset + 8;
    file.read_at(input.point_offset, &mut bytes).map_err(|_| format!("offset {}: the file ends before the offset of the chunk table", input.point_offset))?;
    let mut offset = i64::from_le_bytes(bytes);
    if offset == -1 {
        // Written to a pipe: the offset stands at the end of the file.
        file.read_at(input.file_bytes.saturating_sub(8), &mut bytes).map_err(|error| error.to_string())?;
        offset = i64::from_le_bytes(bytes);
    }
    if offset < first as i64 || offset as u64 > input.file_bytes.saturating_sub(8) {
        return Err(format!("offset {}: the chunk table starts at {offset}, expected {first} (end of its offset) to {} (the file may be cut off)", input.point_offset,
                           input.file_bytes.saturating_sub(8)));
    }
    Ok(offset as u64)
}

fn read_chunks(input: &Input, vlr: &LazVlr) -> Result<Vec<Chunk>, String> {
    let file = FileAt::range(input.descriptor, 0, input.file_bytes);
    let table_at = table_offset(&file, input)?;
    let mut head = [0u8; 8];
    file.read_at(table_at, &mut head).map_err(|error| error.to_string())?;
    let declared = u32::from_le_bytes([head[4], head[5], head[6], head[7]]) as u64;
    let first = input.point_offset + 8;
    let most = (table_at - first) / input.record_bytes as u64; // a chunk starts with a whole record
    let variable = vlr.uses_variable_size_chunks();
    let needed = if variable { 1 } else { input.count.div_ceil(vlr.chunk_size() as u64) };
    if declared > most || declared < needed {
        return Err(format!("offset {}: the chunk table declares {declared} chunks, expected {needed} (for {} points) to {most} (room in the file)", table_at + 4, input.count));
    }
    let mut source = Buffered::new(FileAt::range(input.descriptor, table_at, input.file_bytes));
    let table = ChunkTable::read(&mut source, variable).map_err(|error| format!("offset {table_at}: the chunk table is damaged: {error}"))?;
    let mut chunks = Vec::with_capacity(table.len());
    let (mut offset, mut left) = (first, input.count);
    for (i, entry) in table.as_ref().iter().enumerate() {
        if left == 0 {
            break; // what follows was not announced
        }
        let bytes = entry.byte_count & 0xffff_ffff; // the crate widens a signed number
        let points = if variable { entry.point_count & 0xffff_ffff } else { vlr.chunk_size() as u64 }.min(left);
        if bytes > table_at - offset {
            return Err(format!("chunk {} of {declared} has {bytes} bytes from offset {offset}, the chunk table starts at {table_at}", i + 1));
        }
        if points > 0 {
            check_chunk(i, points, offset, bytes, input)?;
            chunks.push(Chunk { points, offset, bytes });
        }
        offset += bytes;
        left -= points;
    }
    if left > 0 {
        return Err(format!("the header declares {} points, the chunks hold {}", input.count, input.count - left));
    }
    Ok(chunks)
}

fn check_chunk(index: usize, points: u64, offset: u64, bytes: u64, input: &Input) -> Result<(), String> {
    if bytes < input.record_bytes as u64 || points / MOST_POINTS_PER_BYTE > bytes {
        return Err(format!("chunk {} (offset {offset}): {bytes} compressed bytes cannot hold {points} points of {} bytes", index + 1, input.record_bytes));
    }
    Ok(())
}

/// Layers that are worth decoding; x and y always are. Extra bytes may hold normals, so that only positions go without.
fn selection(parts: i32) -> DecompressionSelection {
    let positions = DecompressionSelection::xy_returns_channel().decompress_z();
    match parts {
        0 => DecompressionSelection::all(),
        1 => positions.decompress_rgb().decompress_extra_bytes(),
        _ => positions,
    }
}

impl Laz {
    pub fn open(input: &Input) -> Result<Self, String> {
        let (vlr, compressor) = parse_vlr(input)?;
        let chunks = if compressor == POINT_WISE {
            let bytes = input.file_bytes - input.point_offset;
            check_chunk(0, input.count, input.point_offset, bytes, input)?;
            vec![Chunk { points: input.count, offset: input.point_offset, bytes }]
        } else {
            read_chunks(input, &vlr)?
        };
        Ok(Self {
            descriptor: input.descriptor,
            record_bytes: input.record_bytes,
            layered: compressor == LAYERED_CHUNKED,
            items: vlr.items().clone(),
            chunks,
        })
    }

    /// What a decoder of this chunk holds beside small tables.
    pub fn decoder_bytes(&self, chunk: usize) -> u64 {
        if self.layered {
            self.chunks[chunk].bytes
        } else {
            1 << 16
        }
    }

    // A layered chunk says for each layer how many bytes follow, and the crate allocates them all.
    fn check_layers(&self, chunk: &Chunk) -> Result<(), String> {
        let layers: usize = self.items.iter().map(|item| match item.item_type() {
            LazItemType::Point14 => 9,
            LazItemType::RGBNIR14 => 2,
            LazItemType::Byte14(count) => count as usize,
            _ => 1,
        }).sum();
        let mut bytes = vec![0u8; 4 + 4 * layers];
        let file = FileAt::range(self.descriptor, chunk.offset, chunk.offset + chunk.bytes);
        let at = chunk.offset + self.record_bytes as u64;
        file.read_at(at, &mut bytes).map_err(|_| format!("offset {at}: the chunk of {} bytes ends before the sizes of its {layers} layers", chunk.bytes))?;
        let sum: u64 = bytes[4..].chunks_exact(4).map(|b| u32::from_le_bytes([b[0], b[1], b[2], b[3]]) as u64).sum();
        let room = chunk.bytes - self.record_bytes as u64 - bytes.len() as u64;
        if sum > room {
            return Err(format!("offset {at}: the layers of the chunk have {sum} bytes, it has room for {room}"));
        }
        Ok(())
    }

    pub fn decoder(&self, index: usize, parts: i32) -> Result<Decoder, String> {
        let chunk = self.chunks[index];
        if self.layered {
            self.check_layers(&chunk)?;
        }
        let source = Buffered::new(FileAt::range(self.descriptor, chunk.offset, chunk.offset + chunk.bytes));
        let mut records: Box<dyn RecordDecompressor<Buffered> + Send> = if self.layered {
            Box::new(LayeredPointRecordDecompressor::new(source))
        } else {
            Box::new(SequentialPointRecordDecompressor::new(source))
        };
        records.set_fields_from(&self.items).map_err(|error| error.to_string())?;
        records.set_selection(selection(parts));
        if records.record_size() != self.record_bytes {
            return Err(format!("laszip items make records of {} bytes, expected {}", records.record_size(), self.record_bytes));
        }
        Ok(Decoder { records, record_bytes: self.record_bytes, chunk, index, done: 0 })
    }
}

pub struct Decoder {
    records: Box<dyn RecordDecompressor<Buffered> + Send>,
    record_bytes: usize,
    chunk: Chunk,
    index: usize,
    done: u64,
}

impl Decoder {
    /// The next rows.len() / record_bytes records of the chunk.
    pub fn decode(&mut self, rows: &mut [u8]) -> Result<(), String> {
        let count = (rows.len() / self.record_bytes) as u64;
        if count > self.chunk.points - self.done {
            return Err(format!("chunk {} has {} points", self.index + 1, self.chunk.points));
        }
        self.records.decompress_many(rows).map_err(|error| {
            format!("chunk {} (offset {}, {} bytes, {} points): {error}", self.index + 1, self.chunk.offset, self.chunk.bytes, self.chunk.points)
        })?;
        self.done += count;
        Ok(())
    }
}
