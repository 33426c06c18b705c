//! Laws and snapshots of rasters.
