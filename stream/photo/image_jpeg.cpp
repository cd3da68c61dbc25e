#include <cstdio>
// jpeglib.h needs stdio first
#include <jpeglib.h>
#include <jerror.h>

#include "stream/photo/image_io_detail.h"

namespace chiaro::stream {
namespace {

constexpr int kMaxScans = 500;  // a progressive file can hold scans without end; real ones hold about ten

struct ErrorManager : jpeg_error_mgr {
  std::jmp_buf jump;
  char message[JMSG_LENGTH_MAX] = {};
};

[[noreturn]] void fail(j_common_ptr info) {
  auto* errors = static_cast<ErrorManager*>(info->err);
  errors->format_message(info, errors->message);
  std::longjmp(errors->jump, 1);
}

/// Warnings that mean lost pixels end the reading; the others (odd markers, trailing bytes) do not change the picture.
void on_message(j_common_ptr info, int level) {
  if (level >= 0) return;
  switch (info->err->msg_code) {
    case JWRN_HIT_MARKER:
    case JWRN_HUFF_BAD_CODE:
    case JWRN_ARITH_BAD_CODE:
    case JWRN_JPEG_EOF:
    case JWRN_MUST_RESYNC: fail(info);
    default: break;
  }
}

void on_progress(j_common_ptr info) {
  if (info->is_decompressor && reinterpret_cast<j_decompress_ptr>(info)->input_scan_number > kMaxScans) {
    auto* errors = static_cast<ErrorManager*>(info->err);
    std::snprintf(errors->message, sizeof errors->message, "more than %d scans", kMaxScans);
    std::longjmp(errors->jump, 1);
  }
}

class JpegReader : public detail::RowReader {
 public:
  JpegReader(const std::filesystem::path& path, const ImageOptions& options) : path_(path), file_(detail::open_c_file(path)) {
    jpeg_.err = jpeg_std_error(&errors_);
    errors_.error_exit = fail;
    errors_.emit_message = on_message;
    errors_.output_message = [](j_common_ptr) {};
    progress_.progress_monitor = on_progress;
    call("header", [&] {
      jpeg_create_decompress(&jpeg_);
      jpeg_.progress = &progress_;
      jpeg_stdio_src(&jpeg_, file_.get());
      jpeg_save_markers(&jpeg_, JPEG_APP0 + 1, 0xffff);   // EXIF
      jpeg_save_markers(&jpeg_, JPEG_APP0 + 2, 0xffff);
      jpeg_read_header(&jpeg_, TRUE);
    });
    try {
      start(options);
    } catch (...) {
      jpeg_destroy_decompress(&jpeg_);
      throw;
    }
  }
  ~JpegReader() override { jpeg_destroy_decompress(&jpeg_); }

  void read_rows(int y0, int rows, float* out) override {
    const std::size_t count = row_.size();
    // Of a progressive file this unpacks all of it: not for its size alone.
    if (!started_) call_at(0, [&] { jpeg_start_decompress(&jpeg_); });
    started_ = true;
    for (int y = y0; y < y0 + rows; ++y, out += count) {
      JSAMPROW row = row_.data();
      call_at(y, [&] { jpeg_read_scanlines(&jpeg_, &row, 1); });
      for (std::size_t i = 0; i < count; ++i) out[i] = static_cast<float>(row_[i]) / 255.0f;
    }
    if (y0 + rows == info.height) call("end", [&] { jpeg_finish_decompress(&jpeg_); });
  }

 private:
  template <class Call>
  void call(const char* where, Call&& body) {
    if (detail::guarded(errors_.jump, body)) return;
    const std::string message = concat(path_.string(), ": JPEG ", where, ": ", errors_.message);
    if (info.width == 0) jpeg_destroy_decompress(&jpeg_);  // still in the constructor
    throw Error(message);
  }
  template <class Call>
  void call_at(int y, Call&& body) {
    if (!detail::guarded(errors_.jump, body)) throw Error(concat(path_.string(), ": JPEG row ", y, ": ", errors_.message));
  }

  void start(const ImageOptions& options) {
    detail::check_size(path_, jpeg_.image_width, jpeg_.image_height, options.limits);
    if (jpeg_.jpeg_color_space == JCS_CMYK || jpeg_.jpeg_color_space == JCS_YCCK || jpeg_.jpeg_color_space == JCS_UNKNOWN)
      throw Error(concat(path_.string(), ": JPEG with ", jpeg_.num_components, " components (CMYK or unknown), expected grey or RGB"));
    // Progressive files cannot be streamed: the library keeps all coefficients.
    if (jpeg_has_multiple_scans(&jpeg_))
      detail::check_buffer(path_, std::uint64_t{jpeg_.image_width} * jpeg_.image_height * static_cast<std::uint64_t>(jpeg_.num_components) * sizeof(JCOEF), options.limits,
                           "a progressive JPEG");
    jpeg_.out_color_space = jpeg_.jpeg_color_space == JCS_GRAYSCALE ? JCS_GRAYSCALE : JCS_RGB;
    jpeg_.dct_method = JDCT_ISLOW;
    read_profile();
    for (const jpeg_marker_struct* m = jpeg_.marker_list; m; m = m->next)
      if (m->marker == JPEG_APP0 + 1) detail::note_orientation(detail::exif_orientation({m->data, m->data_length}), info);
    call_at(0, [&] { jpeg_calc_output_dimensions(&jpeg_); });
    info.format = "JPEG";
    info.channels = jpeg_.output_components;
    info.bits = 8;
    row_.resize(std::size_t{jpeg_.output_width} * static_cast<std::size_t>(jpeg_.output_components));
    info.width = static_cast<int>(jpeg_.output_width);
    info.height = static_cast<int>(jpeg_.output_height);
  }

  void read_profile() {
    JOCTET* data = nullptr;
    unsigned int size = 0;
    boolean found = FALSE;
    if (!detail::guarded(errors_.jump, [&] { found = jpeg_read_icc_profile(&jpeg_, &data, &size); })) return;
    const std::unique_ptr<JOCTET, decltype(&std::free)> owner(data, std::free);
    if (found) detail::read_profile({data, size}, info);
  }

  bool started_ = false;
  std::filesystem::path path_;
  detail::FilePtr file_;
  ErrorManager errors_;
  jpeg_progress_mgr progress_{};
  jpeg_decompress_struct jpeg_{};
  std::vector<JSAMPLE> row_;
};

}  // namespace

std::unique_ptr<detail::RowReader> detail::open_jpeg(const std::filesystem::path& path, const ImageOptions& options) {
  return std::make_unique<JpegReader>(path, options);
}

}  // namespace chiaro::stream
