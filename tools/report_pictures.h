/// The part of the report that shows photographs: their pictures with captions, and how to read them. For .cpp files only.
#pragma once
#include "tools/report_data.h"
#include "tools/report_page.h"

namespace chiaro::tools {

void how_to_read_pictures(Page& page, const ReportData& data);
void photograph_pictures(Page& page, const ReportData& data);

}  // namespace chiaro::tools
