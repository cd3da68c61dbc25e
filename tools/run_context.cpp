#include "stream/base/heap.h"
#include "stream/base/error.h"
#include "tools/run_context_json.h"

namespace chiaro::tools {
namespace {
using Json = nlohmann::ordered_json;

/// Part of every key: raise it when a stage's result changes for the same inputs.
constexpr std::uint64_t kPipelineVersion = 15;
}  // namespace

const Photo* photo_of(const Shoot& shoot, const ReferenceInput& reference) {
  for (const Photo& photo : shoot.photos)
    if (photo.index_in_acquisition == reference.photograph) return &photo;
  return nullptr;
}

Hasher keyed(std::string_view stage) {
  Hasher h;
  h.add(kPipelineVersion).add(stage);
  return h;
}

void RunContext::note_both(const std::string& text) {
  report.note(text);
  record.note(text);
}

void RunContext::leave_out(const PhotographInput& p, const std::string& reason) {
  report.note(concat(p.file.filename().string(), ": left out: ", reason));
  record.left_out("photograph", p.key, reason);
  // What an earlier run made of it is no result any more.
  const std::filesystem::path pictures = folder.pictures(p.key);
  std::error_code code;
  for (const char* name : {"albedo.exr", "sigma.exr", "light.exr", "residual.exr"}) std::filesystem::remove(pictures / name, code);
  std::filesystem::remove(pictures, code);
}

Json RunContext::task(const std::string& name, const std::string& key, const std::vector<std::filesystem::path>& outputs, const std::function<Json()>& body) {
  report.check();
  progress.begun(name);
  const TaskOutcome outcome = tasks.run(name, key, outputs, [&] { return body().dump(-1, ' ', false, Json::error_handler_t::replace); });
  if (!outcome.reused) return_freed_memory();
  progress.done(name);
  record.stage(name, outcome.reused ? 0.0 : outcome.seconds, outcome.reused);
  return Json::parse(outcome.info_json);
}

optimize::ObserveInput RunContext::observe_input(const Shoot& shoot, const Photo& p) const {
  optimize::ObserveInput input{p.camera, folder.radiance(p.input->key), folder.gbuffer(p.input->key), p.noise, {}, shoot.ambient_scale};
  if (shoot.has_flash()) input.flash_in_camera = shoot.acquisition->flash->offset_in_camera;
  return input;
}

}  // namespace chiaro::tools
