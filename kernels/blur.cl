// Gaussian blur of lined images (see vectors.clh), one direction a kernel.
//
// Beyond the border there is nothing: what is left of the taps on the detector is scaled up to 1. A
// work-item makes LANES columns of one row; global size (blocks of LANES columns, rows, views),
// rounded up at will.

#include "vectors.clh"

// Along the direction of rows (vertical).
kernel required_group void blur_rows(
    global float *restrict blurred, // lined (views, rows, stride)
    const ulong blurred_offset,
    global const float *restrict image, // lined (views, rows, stride)
    const ulong image_offset,
    global const float *restrict taps, // (2 radius + 1,)
    const ulong taps_offset,
    const int radius, // rows
    const int rows,
    const int columns,
    const int stride,
    const int views)
{
    blurred += blurred_offset;
    image += image_offset;
    taps += taps_offset;
    const int i = get_global_id(0) * LANES, j = get_global_id(1), view = get_global_id(2);
    if (i >= columns || j >= rows || view >= views)
        return;
    const ulong at = ((ulong)view * rows + j) * stride + MARGIN + i;
    real sum = 0.0f;
    float part = 0.0f;
    for (int k = -min(radius, j); k <= min(radius, rows - 1 - j); ++k) {
        sum += taps[k + radius] * load_global(image + at + (long)k * stride);
        part += taps[k + radius];
    }
    store_global(sum / part, blurred + at);
}

// Along the direction of columns (horizontal); radius <= MARGIN.
kernel required_group void blur_columns(
    global float *restrict blurred, // lined (views, rows, stride)
    const ulong blurred_offset,
    global const float *restrict image, // lined (views, rows, stride)
    const ulong image_offset,
    global const float *restrict taps, // (2 radius + 1,)
    const ulong taps_offset,
    const int radius, // columns
    global const float *restrict part, // lined (1, stride): 1 / taps on the detector, 0 off it
    const ulong part_offset,
    const int rows,
    const int columns,
    const int stride,
    const int views)
{
    blurred += blurred_offset;
    image += image_offset;
    taps += taps_offset;
    part += part_offset;
    const int i = get_global_id(0) * LANES, j = get_global_id(1), view = get_global_id(2);
    if (i >= columns || j >= rows || view >= views)
        return;
    const ulong at = ((ulong)view * rows + j) * stride + MARGIN + i;
    real sum = 0.0f;
    for (int k = -radius; k <= radius; ++k)
        sum += taps[k + radius] * load_global(image + at + k);
    store_global(sum * load_global(part + MARGIN + i), blurred + at);
}
