//! The C ABI of this library; rust_formats.h in stream/cloud says the same in C. No panic leaves it, and it prints nothing.
//! Functions that return int give 0, or 1 with a message.
mod e57_scans;
mod file_at;
mod laz_chunks;
mod pages;

use std::ffi::{c_char, c_int, c_void};
use std::panic::{catch_unwind, AssertUnwindSafe};
use std::slice::{from_raw_parts, from_raw_parts_mut};
use std::sync::Once;

const MESSAGE_BYTES: usize = 512;

fn put_message(text: &str, message: *mut c_char) {
    let mut end = text.len().min(MESSAGE_BYTES - 1);
    while !text.is_char_boundary(end) {
        end -= 1;
    }
    unsafe {
        std::ptr::copy_nonoverlapping(text.as_ptr().cast(), message, end);
        *message.add(end) = 0;
    }
}

/// Runs `work`; its error, or its panic, becomes the message.
fn guarded(message: *mut c_char, work: impl FnOnce() -> Result<(), String>) -> c_int {
    static SILENCE: Once = Once::new();
    SILENCE.call_once(|| std::panic::set_hook(Box::new(|_| {})));
    let what = match catch_unwind(AssertUnwindSafe(work)) {
        Ok(Ok(())) => return 0,
        Ok(Err(what)) => what,
        Err(panic) => {
            let text = panic.downcast_ref::<String>().map(String::as_str).or(panic.downcast_ref::<&str>().copied());
            format!("the file is damaged (the decoder stopped: {})", text.unwrap_or("unknown"))
        }
    };
    put_message(&what, message);
    1
}

#[repr(C)]
pub struct ChiaroLazInput {
    descriptor: c_int,
    point_format: c_int,
    file_bytes: u64,
    point_offset: u64,
    count: u64,
    record_bytes: u64,
    vlr: *const u8,
    vlr_bytes: u64,
}

#[repr(C)]
pub struct ChiaroLazChunk {
    points: u64,
    decoder_bytes: u64,
}

/// # Safety
/// As rust_formats.h says, for this and all functions below: pointers are valid, handles come from here and are freed once.
#[no_mangle]
pub unsafe extern "C" fn chiaro_laz_open(input: *const ChiaroLazInput, laz: *mut *mut c_void, message: *mut c_char) -> c_int {
    guarded(message, || {
        let input = &*input;
        let opened = laz_chunks::Laz::open(&laz_chunks::Input {
            descriptor: input.descriptor,
            file_bytes: input.file_bytes,
            point_offset: input.point_offset,
            count: input.count,
            record_bytes: input.record_bytes as usize,
            point_format: input.point_format as u8,
            vlr: from_raw_parts(input.vlr, input.vlr_bytes as usize),
        })?;
        *laz = Box::into_raw(Box::new(opened)).cast();
        Ok(())
    })
}

#[no_mangle]
pub unsafe extern "C" fn chiaro_laz_free(laz: *mut c_void) {
    drop(Box::from_raw(laz.cast::<laz_chunks::Laz>()));
}

#[no_mangle]
pub unsafe extern "C" fn chiaro_laz_num_chunks(laz: *const c_void) -> u64 {
    (*laz.cast::<laz_chunks::Laz>()).chunks.len() as u64
}

#[no_mangle]
pub unsafe extern "C" fn chiaro_laz_chunk(laz: *const c_void, index: u64) -> ChiaroLazChunk {
    let laz = &*laz.cast::<laz_chunks::Laz>();
    let index = index as usize;
    ChiaroLazChunk { points: laz.chunks[index].points, decoder_bytes: laz.decoder_bytes(index) }
}

#[no_mangle]
pub unsafe extern "C" fn chiaro_laz_decoder_new(laz: *const c_void, chunk: u64, parts: c_int, decoder: *mut *mut c_void, message: *mut c_char) -> c_int {
    guarded(message, || {
        let made = (*laz.cast::<laz_chunks::Laz>()).decoder(chunk as usize, parts)?;
        *decoder = Box::into_raw(Box::new(made)).cast();
        Ok(())
    })
}

#[no_mangle]
pub unsafe extern "C" fn chiaro_laz_decode(decoder: *mut c_void, rows: *mut u8, bytes: u64, message: *mut c_char) -> c_int {
    guarded(message, || (*decoder.cast::<laz_chunks::Decoder>()).decode(from_raw_parts_mut(rows, bytes as usize)))
}

#[no_mangle]
pub unsafe extern "C" fn chiaro_laz_decoder_free(decoder: *mut c_void) {
    drop(Box::from_raw(decoder.cast::<laz_chunks::Decoder>()));
}

#[repr(C)]
pub struct ChiaroE57Input {
    descriptor: c_int,
    file_bytes: u64,
    no_position_bits: u64,
}

#[repr(C)]
pub struct ChiaroE57Info {
    declared_points: u64,
    num_properties: u64,
    extra_bytes: u64,
    has_normal: u8,
    has_colour: u8,
    colour_is_16_bit: u8,
    position_is_double: u8,
}

#[repr(C)]
pub struct ChiaroE57Property {
    name: [c_char; 80],
    scalar: c_int,
}

#[repr(C)]
pub struct ChiaroE57Output {
    most_points: u64,
    positions: *mut f64,
    normals: *mut f32,
    colours: *mut u16,
    extras: *mut u8,
}

#[no_mangle]
pub unsafe extern "C" fn chiaro_e57_open(input: *const ChiaroE57Input, scans: *mut *mut c_void, message: *mut c_char) -> c_int {
    guarded(message, || {
        let input = &*input;
        let opened = e57_scans::Scans::open(&e57_scans::Input {
            descriptor: input.descriptor,
            file_bytes: input.file_bytes,
            no_position_bits: input.no_position_bits,
        })?;
        *scans = Box::into_raw(Box::new(opened)).cast();
        Ok(())
    })
}

#[no_mangle]
pub unsafe extern "C" fn chiaro_e57_free(scans: *mut c_void) {
    drop(Box::from_raw(scans.cast::<e57_scans::Scans>()));
}

#[no_mangle]
pub unsafe extern "C" fn chiaro_e57_info(scans: *const c_void) -> ChiaroE57Info {
    let scans = &*scans.cast::<e57_scans::Scans>();
    ChiaroE57Info {
        declared_points: scans.declared,
        num_properties: scans.properties.len() as u64,
        extra_bytes: scans.extra_bytes() as u64,
        has_normal: scans.has_normal as u8,
        has_colour: scans.has_colour as u8,
        colour_is_16_bit: scans.colour_is_16_bit as u8,
        position_is_double: scans.position_is_double as u8,
    }
}

#[no_mangle]
pub unsafe extern "C" fn chiaro_e57_property(scans: *const c_void, index: u64) -> ChiaroE57Property {
    let property = &(&(*scans.cast::<e57_scans::Scans>()).properties)[index as usize];
    let mut name = [0; 80];
    for (to, from) in name.iter_mut().zip(property.name.bytes().take(79)) {
        *to = from as c_char;
    }
    ChiaroE57Property { name, scalar: property.scalar as c_int }
}

/// An empty slice where there is no array.
unsafe fn array<'a, T>(at: *mut T, count: usize) -> &'a mut [T] {
    if at.is_null() || count == 0 {
        return &mut [];
    }
    from_raw_parts_mut(at, count)
}

#[no_mangle]
pub unsafe extern "C" fn chiaro_e57_read(scans: *mut c_void, output: *const ChiaroE57Output, done: *mut u64, message: *mut c_char) -> c_int {
    guarded(message, || {
        let scans = &mut *scans.cast::<e57_scans::Scans>();
        let output = &*output;
        let most = output.most_points as usize;
        let mut arrays = e57_scans::Output {
            positions: array(output.positions, 3 * most),
            normals: array(output.normals, 3 * most),
            colours: array(output.colours, 3 * most),
            extras: array(output.extras, scans.extra_bytes() * most),
        };
        *done = scans.read(&mut arrays)? as u64;
        Ok(())
    })
}
