# `chiaro synth`: clouds of any size from a formula, and photographs of them.
add_module(tools_synth
  SOURCES cmd_synth.cpp synth_body.cpp synth_project.cpp synth_render.cpp synth_scene.cpp synth_surfaces.cpp synth_write.cpp
  DEPENDS tools_core optimize stream_cloud stream_photo stream_base PRIVATE_DEPENDS nlohmann_json::nlohmann_json)
if(TARGET chiaro)
  target_link_libraries(chiaro PRIVATE tools_synth)
endif()
