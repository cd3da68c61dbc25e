# The whole pipeline: what `chiaro run` calls.
add_module(tools_run SOURCES cmd_render.cpp cmd_run.cpp ingest.cpp blend_record.cpp light_record.cpp pipeline.cpp run_context.cpp run_layer.cpp run_lights.cpp run_photographs.cpp run_refine.cpp run_solve.cpp task_log.cpp views.cpp
  DEPENDS tools_core tools_export tools_report blend optimize surfels stream_store stream_photo stream_cloud stream_base PRIVATE_DEPENDS nlohmann_json::nlohmann_json PkgConfig::tomlplusplus)
