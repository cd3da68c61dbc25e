add_module(tools_export SOURCES export_points.cpp fill_unseen.cpp inserted_points.cpp DEPENDS stream_store stream_cloud PRIVATE_DEPENDS nlohmann_json::nlohmann_json)
