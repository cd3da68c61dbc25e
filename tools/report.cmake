# `chiaro report` and `chiaro status`: what a run left, for people and for programs.
add_module(tools_report
  SOURCES cmd_report.cpp cmd_status.cpp report.cpp report_data.cpp report_html.cpp report_page.cpp report_palette.cpp report_photo.cpp report_pictures.cpp report_weights.cpp status.cpp
  DEPENDS tools_core blend stream_photo stream_base PRIVATE_DEPENDS nlohmann_json::nlohmann_json PNG::PNG)
if(TARGET chiaro)
  target_link_libraries(chiaro PRIVATE tools_report)
endif()
