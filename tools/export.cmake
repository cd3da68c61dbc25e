add_module(tools_export SOURCES export_points.cpp fill_unseen.cpp DEPENDS stream_store stream_cloud)
