# `chiaro synth`: clouds of any size from a formula.
add_module(tools_synth
  SOURCES cmd_synth.cpp synth_scene.cpp synth_surfaces.cpp synth_write.cpp
  DEPENDS tools_core stream_cloud stream_base PRIVATE_DEPENDS nlohmann_json::nlohmann_json)
if(TARGET chiaro)
  target_link_libraries(chiaro PRIVATE tools_synth)
endif()
