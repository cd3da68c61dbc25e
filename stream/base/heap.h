/// The allocator's side of the memory that the user allows.
#pragma once

namespace chiaro {

/// Gives memory that was freed back to the system, where the allocator keeps it for later. Small blocks that live on pin what was freed around them: a stage
/// that held half of --memory leaves it resident, and the next one, which allocates otherwise (ray structures take pages of their own), comes on top of it.
void return_freed_memory();

}  // namespace chiaro
