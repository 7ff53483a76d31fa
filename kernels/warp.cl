// Shift and magnification of images by cubic B-splines: corrected(q) = measured(c + m (q - c) + t),
// c the centre ((columns - 1) / 2, (rows - 1) / 2), q and t ordered (column, row).
//
// Neither axis depends on the other, so that the two-dimensional spline is two one-dimensional
// ones. Along each axis the coefficients are the samples convolved with sqrt(3) z^|k|,
// z = sqrt(3) - 2 (M. Unser, IEEE Signal Processing Magazine 16(6), 1999, eq. 17), and four of them
// make a value. Samples and coefficients go on as mirror images about the outermost sample;
// positions off the image are moved to its border.
//
// Steps: prefilter_rows, resample_rows, prefilter_columns, resample_columns. A work-item makes
// LANES columns of one row. Global sizes are (blocks of LANES columns, rows, views), rounded up at
// will. "Lined" images (views, rows, stride) have MARGIN columns before and after each line, here
// with its mirror image; a line takes the columns rounded up to a multiple of 16.

#include "vectors.clh"

#define TAPS 14 // on each side, <= MARGIN: the next is 1e-8 of the first

#define MOTION_FIELDS 3 // shift_u, shift_v [pixel], magnification

// index of the sample that stands at i, mirrored about 0 and n - 1
static inline int mirrored(int i, const int n)
{
    if (n == 1)
        return 0;
    i = abs(i);
    while (i >= n)
        i = abs(2 * (n - 1) - i);
    return i;
}

// Where corrected sample i of n is in the measured line: `fraction` past the sample returned.
static inline int position(
    const int i, const int n, const float shift, const float magnification, float *fraction)
{
    // The displacement, not the position, keeps its digits on wide detectors.
    const float wanted = (magnification - 1.0f) * (i - 0.5f * (n - 1)) + shift;
    const float displacement = clamp(wanted, (float)-i, (float)(n - 1 - i));
    const float whole = floor(displacement);
    *fraction = displacement - whole;
    return i + (int)whole;
}

kernel required_group void prefilter_rows(
    global float *restrict coefficients, // (views, rows, columns)
    const ulong coefficients_offset,
    global const float *restrict image, // (views, rows, columns)
    const ulong image_offset,
    global const float *restrict taps, // (TAPS + 1,), from the centre outwards
    const ulong taps_offset,
    const int columns,
    const int rows,
    const int views)
{
    coefficients += coefficients_offset;
    image += image_offset;
    taps += taps_offset;
    const int i = get_global_id(0) * LANES, j = get_global_id(1), view = get_global_id(2);
    if (i >= columns || j >= rows || view >= views)
        return;
    image += (ulong)view * rows * columns + i;
    coefficients += ((ulong)view * rows + j) * columns + i;
    if (i + LANES > columns) {
        for (int c = 0; c < columns - i; ++c) {
            float sum = taps[0] * image[(ulong)j * columns + c];
            for (int k = 1; k <= TAPS; ++k)
                sum += taps[k] * (image[(ulong)mirrored(j - k, rows) * columns + c]
                                  + image[(ulong)mirrored(j + k, rows) * columns + c]);
            coefficients[c] = sum;
        }
        return;
    }
    real sum = taps[0] * load_global(image + (ulong)j * columns);
    if (j >= TAPS && j + TAPS < rows) {
        global const float *above = image + (ulong)j * columns, *below = above;
#pragma unroll 4 // all 14 would take a GPU's registers
        for (int k = 1; k <= TAPS; ++k) {
            above -= columns;
            below += columns;
            sum += taps[k] * (load_global(above) + load_global(below));
        }
    } else {
        for (int k = 1; k <= TAPS; ++k) {
            global const float *above = image + (ulong)mirrored(j - k, rows) * columns;
            global const float *below = image + (ulong)mirrored(j + k, rows) * columns;
            sum += taps[k] * (load_global(above) + load_global(below));
        }
    }
    store_global(sum, coefficients);
}

// Global size (blocks of LANES columns of a whole lined row, rows, views).
kernel required_group void resample_rows(
    global float *restrict resampled, // lined (views, rows, stride)
    const ulong resampled_offset,
    global const float *restrict coefficients, // along rows' direction, (views, rows, columns)
    const ulong coefficients_offset,
    global const float *restrict motion, // (views, MOTION_FIELDS)
    const ulong motion_offset,
    const int columns,
    const int rows,
    const int views,
    const int stride)
{
    resampled += resampled_offset;
    coefficients += coefficients_offset;
    motion += motion_offset;
    const int x = get_global_id(0) * LANES, j = get_global_id(1), view = get_global_id(2);
    if (x >= stride || j >= rows || view >= views)
        return;
    global const float *m = motion + (ulong)view * MOTION_FIELDS;
    float fraction, w[4];
    const int base = position(j, rows, m[1], m[2], &fraction);
    spline_weights(fraction, w);
    coefficients += (ulong)view * rows * columns;
    resampled += ((ulong)view * rows + j) * stride + x;
    global const float *line[4];
    for (int k = 0; k < 4; ++k)
        line[k] = coefficients + (ulong)mirrored(base - 1 + k, rows) * columns;
    const int i = x - MARGIN;
    if (i >= 0 && i + LANES <= columns) {
        real sum = w[0] * load_global(line[0] + i);
        for (int k = 1; k < 4; ++k)
            sum += w[k] * load_global(line[k] + i);
        store_global(sum, resampled);
        return;
    }
    for (int c = 0; c < LANES; ++c) {
        const int from = mirrored(min(i + c, columns + MARGIN), columns);
        resampled[c] = w[0] * line[0][from] + w[1] * line[1][from] + w[2] * line[2][from]
                       + w[3] * line[3][from];
    }
}

kernel required_group void prefilter_columns(
    global float *restrict coefficients, // (views, rows, columns)
    const ulong coefficients_offset,
    global const float *restrict image, // lined (views, rows, stride)
    const ulong image_offset,
    global const float *restrict taps, // (TAPS + 1,), from the centre outwards
    const ulong taps_offset,
    const int columns,
    const int rows,
    const int views,
    const int stride)
{
    coefficients += coefficients_offset;
    image += image_offset;
    taps += taps_offset;
    const int i = get_global_id(0) * LANES, j = get_global_id(1), view = get_global_id(2);
    if (i >= columns || j >= rows || view >= views)
        return;
    image += ((ulong)view * rows + j) * stride + MARGIN + i;
    real sum = taps[0] * load_global(image);
    for (int k = 1; k <= TAPS; ++k)
        sum += taps[k] * (load_global(image - k) + load_global(image + k));
    store_columns(sum, coefficients + ((ulong)view * rows + j) * columns + i, columns - i);
}

kernel required_group void resample_columns(
    global float *restrict resampled, // (views, rows, columns)
    const ulong resampled_offset,
    global const float *restrict coefficients, // along columns' direction, (views, rows, columns)
    const ulong coefficients_offset,
    global const float *restrict motion, // (views, MOTION_FIELDS)
    const ulong motion_offset,
    const int columns,
    const int rows,
    const int views)
{
    resampled += resampled_offset;
    coefficients += coefficients_offset;
    motion += motion_offset;
    const int i = get_global_id(0) * LANES, j = get_global_id(1), view = get_global_id(2);
    if (i >= columns || j >= rows || view >= views)
        return;
    motion += (ulong)view * MOTION_FIELDS;
    const float shift = motion[0], magnification = motion[2];
    coefficients += ((ulong)view * rows + j) * columns;
    resampled += ((ulong)view * rows + j) * columns + i;
    const int last = min(i + LANES, columns) - 1;
    float fraction;
    const int base = position(i, columns, shift, magnification, &fraction);
    const int end = position(last, columns, shift, magnification, &fraction);
    if (end - base == LANES - 1 && base >= 1 && end + 2 < columns) {
        // Magnifications are near 1: neighbours nearly always have neighbouring coefficients.
        const real centred = i + RAMP - 0.5f * (columns - 1);
        const real f = (magnification - 1.0f) * centred + (shift - (base - i)), g = 1.0f - f;
        global const float *c = coefficients + base;
        real sum = g * g * g * (1.0f / 6.0f) * load_global(c - 1);
        sum += ((2.0f / 3.0f) - f * f * (1.0f - 0.5f * f)) * load_global(c);
        sum += ((2.0f / 3.0f) - g * g * (1.0f - 0.5f * g)) * load_global(c + 1);
        sum += f * f * f * (1.0f / 6.0f) * load_global(c + 2);
        store_global(sum, resampled);
        return;
    }
    for (int x = i; x <= last; ++x) {
        float w[4], sum = 0.0f;
        const int at = position(x, columns, shift, magnification, &fraction);
        spline_weights(fraction, w);
        for (int k = 0; k < 4; ++k)
            sum += w[k] * coefficients[mirrored(at - 1 + k, columns)];
        resampled[x - i] = sum;
    }
}
