"""OpenCL itself: devices, builds, kernels and buffers."""
