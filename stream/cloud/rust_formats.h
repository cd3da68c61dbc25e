/* What the Rust library in rust_formats/ offers: plain C. src/lib.rs says the same in Rust. Internal to stream/cloud. */
#pragma once
#include <stddef.h>
#include <stdint.h>

#ifdef __cplusplus
extern "C" {
#endif

enum { CHIARO_RUST_MESSAGE_BYTES = 512 };

/* Functions that return int give 0, or 1 with a message of at most CHIARO_RUST_MESSAGE_BYTES with its end. Descriptors stay the caller's and are
 * read at positions; they must outlive the handles. A LAZ handle may be used by many threads, a decoder and an E57 handle by one at a time. */

typedef struct ChiaroLazInput {
  int descriptor, point_format;
  uint64_t file_bytes, point_offset, count, record_bytes;
  const uint8_t* vlr; /* content of the record 22204 of "laszip encoded" */
  uint64_t vlr_bytes;
} ChiaroLazInput;

typedef struct ChiaroLazChunk {
  uint64_t points;        /* 1 or more; those of all chunks add up to ChiaroLazInput::count */
  uint64_t decoder_bytes; /* memory that its decoder takes */
} ChiaroLazChunk;

int chiaro_laz_open(const ChiaroLazInput* input, void** laz, char* message);
void chiaro_laz_free(void* laz);
uint64_t chiaro_laz_num_chunks(const void* laz);
ChiaroLazChunk chiaro_laz_chunk(const void* laz, uint64_t index);
/* parts: 0 all; 1 positions, colours and extra bytes; 2 positions. Where layers allow it (point formats 6 to 10) the rest is left out: constant. */
int chiaro_laz_decoder_new(const void* laz, uint64_t chunk, int parts, void** decoder, char* message);
/* The next bytes / record_bytes records of the chunk, as LAS has them. */
int chiaro_laz_decode(void* decoder, uint8_t* rows, uint64_t bytes, char* message);
void chiaro_laz_decoder_free(void* decoder);

typedef struct ChiaroE57Input {
  int descriptor;
  uint64_t file_bytes;
  uint64_t no_position_bits; /* of the double that stands for the coordinates of a point that its scanner marked invalid */
} ChiaroE57Input;

typedef struct ChiaroE57Info {
  uint64_t declared_points, num_properties, extra_bytes;
  uint8_t has_normal, has_colour, colour_is_16_bit, position_is_double;
} ChiaroE57Info;

typedef struct ChiaroE57Property {
  char name[80];
  int scalar; /* as chiaro::stream::ScalarType */
} ChiaroE57Property;

typedef struct ChiaroE57Output {
  uint64_t most_points;
  double* positions; /* 3 a point, in the frame of the file */
  float* normals;    /* 3 a point; null without */
  uint16_t* colours; /* 3 a point, 0..65535; null without */
  uint8_t* extras;   /* extra_bytes a point, packed in the order of the properties; null without */
} ChiaroE57Output;

int chiaro_e57_open(const ChiaroE57Input* input, void** scans, char* message);
void chiaro_e57_free(void* scans);
ChiaroE57Info chiaro_e57_info(const void* scans);
ChiaroE57Property chiaro_e57_property(const void* scans, uint64_t index);
/* The next points of all scans in order; *done = 0 at the end. */
int chiaro_e57_read(void* scans, const ChiaroE57Output* output, uint64_t* done, char* message);

#ifdef __cplusplus
}
#endif
