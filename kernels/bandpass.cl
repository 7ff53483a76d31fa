// Band-pass of images: difference of two Gaussians, as the coefficients of a cubic B-spline.
//
// D(q) = sum_p c(p) b(q - p) at any real position q, b the cubic B-spline (variance 1/3 pixel^2),
// c = (h * MI) / (h * M) - W, M the mask (0 outside the detector), I the image, h narrow. W(p) is
// the value at p of the plane that fits the image best with the weights H(q - p) M(q), H wide: a
// plain Gaussian filter within, and next to masks and borders no slope turns into structure. W is
// made of means over blocks of `factor` pixels and brought back with cubic B-splines; block mean,
// coarse Gaussian and both splines add up to its variance.
//
// Steps: block_means, wide_rows, wide_columns, expand_columns, narrow_rows, bandpass_columns. A
// work-item makes LANES columns of one row, in block_means one pixel. Global sizes are (columns or
// blocks of LANES columns, rows, views), rounded up at will. All images but the input are lined
// (see vectors.clh). Taps are symmetric and reach `radius` <= MARGIN both ways.

#include "vectors.clh"

#define RIM 2 // blocks before the first; behind the last there are one more

// Means over blocks of factor x factor pixels of the masked image, RIM blocks of zeros around them:
// there the plane is continued, so that splines between blocks reach the borders. Pixels of an
// incomplete last block are left out, as their centre is not the block's.
kernel required_group void block_means(
    global float *restrict means, // lined (views, coarse_rows, coarse_stride)
    const ulong means_offset,
    global const float *restrict image, // (views, rows, columns)
    const ulong image_offset,
    global const float *restrict mask, // lined (rows, stride): > 0 where the image counts
    const ulong mask_offset,
    const int rows,
    const int columns,
    const int stride,
    const int factor, // pixels, >= 1
    const int coarse_rows,
    const int coarse_columns,
    const int coarse_stride,
    const int masked, // 0: every pixel counts, and the mask is not read
    const int views)
{
    means += means_offset;
    image += image_offset;
    mask += mask_offset;
    const int i = get_global_id(0), j = get_global_id(1), view = get_global_id(2);
    if (i >= coarse_columns || j >= coarse_rows || view >= views)
        return;
    const int left = (i - RIM) * factor, top = (j - RIM) * factor;
    const int inside = left >= 0 && top >= 0 && left + factor <= columns && top + factor <= rows;
    float sum = 0.0f;
    for (int y = top; inside && y < top + factor; ++y) {
        global const float *line = image + ((ulong)view * rows + y) * columns;
        for (int x = left; x < left + factor; ++x)
            if (!masked || mask[(ulong)y * stride + MARGIN + x] > 0.0f)
                sum += line[x];
    }
    means[((ulong)view * coarse_rows + j) * coarse_stride + MARGIN + i] = sum / (factor * factor);
}

// Vertical convolutions of the block means with H(k) and k H(k), k in blocks.
kernel required_group void wide_rows(
    global float *restrict zeroth, // lined (views, rows, stride), rows and columns of blocks
    const ulong zeroth_offset,
    global float *restrict first, // likewise
    const ulong first_offset,
    global const float *restrict means, // likewise
    const ulong means_offset,
    global const float *restrict taps, // (2 radius + 1,): H
    const ulong taps_offset,
    const int radius, // rows
    const int rows,
    const int columns,
    const int stride,
    const int views)
{
    zeroth += zeroth_offset;
    first += first_offset;
    means += means_offset;
    taps += taps_offset;
    const int i = get_global_id(0) * LANES, j = get_global_id(1), view = get_global_id(2);
    if (i >= columns || j >= rows || view >= views)
        return;
    const ulong at = ((ulong)view * rows + j) * stride + MARGIN + i;
    real sum = 0.0f, moment = 0.0f;
    for (int k = -min(radius, j); k <= min(radius, rows - 1 - j); ++k) {
        const real value = taps[k + radius] * load_global(means + at + (long)k * stride);
        sum += value;
        moment += k * value;
    }
    store_global(sum, zeroth + at);
    store_global(moment, first + at);
}

// The fitted plane's value: a combination, known in advance, of the image's weighted moments.
kernel required_group void wide_columns(
    global float *restrict wide, // lined (views, rows, stride), rows and columns of blocks
    const ulong wide_offset,
    global const float *restrict zeroth, // lined (views, rows, stride), as from wide_rows
    const ulong zeroth_offset,
    global const float *restrict first, // likewise
    const ulong first_offset,
    global const float *restrict fit, // lined (3, rows, stride): factors of moments 1, u and v
    const ulong fit_offset,
    global const float *restrict taps, // (2 radius + 1,): H
    const ulong taps_offset,
    const int radius, // columns
    const int rows,
    const int columns,
    const int stride,
    const int views)
{
    wide += wide_offset;
    zeroth += zeroth_offset;
    first += first_offset;
    fit += fit_offset;
    taps += taps_offset;
    const int i = get_global_id(0) * LANES, j = get_global_id(1), view = get_global_id(2);
    if (i >= columns || j >= rows || view >= views)
        return;
    const ulong at = ((ulong)view * rows + j) * stride + MARGIN + i;
    real sum = 0.0f, moment_u = 0.0f, moment_v = 0.0f;
    for (int k = -radius; k <= radius; ++k) {
        const float tap = taps[k + radius];
        const real value = tap * load_global(zeroth + at + k);
        sum += value;
        moment_u += k * value;
        moment_v += tap * load_global(first + at + k);
    }
    fit += (ulong)j * stride + MARGIN + i;
    const ulong plane = (ulong)rows * stride;
    const real share = load_global(fit);
    const real value = share * sum + load_global(fit + plane) * moment_u +
                         load_global(fit + 2 * plane) * moment_v;
    // Beyond the line stays 0, also of images that are not finite: the next ones read it.
    store_global(select((real)0.0f, value, share != 0.0f), wide + at);
}

// Cubic B-spline through coarse columns, at every fine column, in the coarse rows. LANES columns
// lean on `span` coarse ones, whose weights are known in advance.
kernel required_group void expand_columns(
    global float *restrict expanded, // lined (views, coarse_rows, stride)
    const ulong expanded_offset,
    global const float *restrict coarse, // lined (views, coarse_rows, coarse_stride)
    const ulong coarse_offset,
    global const float *restrict weights, // lined (span, stride)
    const ulong weights_offset,
    global const int *restrict bases, // (columns / LANES,), rounded up: first coarse column
    const ulong bases_offset,
    const int span, // coarse columns
    const int coarse_rows,
    const int coarse_stride,
    const int columns,
    const int stride,
    const int views)
{
    expanded += expanded_offset;
    coarse += coarse_offset;
    weights += weights_offset;
    bases += bases_offset;
    const int i = get_global_id(0) * LANES, j = get_global_id(1), view = get_global_id(2);
    if (i >= columns || j >= coarse_rows || view >= views)
        return;
    const ulong line = (ulong)view * coarse_rows + j;
    global const float *from = coarse + line * coarse_stride + MARGIN;
    const int base = bases[get_global_id(0)];
    real sum = 0.0f;
    for (int k = 0; k < span; ++k)
        sum += from[base + k] * load_global(weights + (ulong)k * stride + MARGIN + i);
    store_global(sum, expanded + line * stride + MARGIN + i);
}

// Vertical convolution of the masked image with h; what lies beyond the first and last row is 0.
kernel required_group void narrow_rows(
    global float *restrict blurred, // lined (views, rows, stride)
    const ulong blurred_offset,
    global const float *restrict image, // (views, rows, columns)
    const ulong image_offset,
    global const float *restrict mask, // lined (rows, stride): > 0 where the image counts
    const ulong mask_offset,
    global const float *restrict taps, // (2 radius + 1,): h
    const ulong taps_offset,
    const int radius, // rows
    const int rows,
    const int columns,
    const int stride,
    const int masked, // 0: every pixel counts, and the mask is not read
    const int views)
{
    blurred += blurred_offset;
    image += image_offset;
    mask += mask_offset;
    taps += taps_offset;
    const int i = get_global_id(0) * LANES, j = get_global_id(1), view = get_global_id(2);
    if (i >= columns || j >= rows || view >= views)
        return;
    image += ((ulong)view * rows + j) * columns + i;
    mask += (ulong)j * stride + MARGIN + i;
    real sum = 0.0f;
    for (int k = -min(radius, j); k <= min(radius, rows - 1 - j); ++k) {
        global const float *from = image + (long)k * columns;
        real value = load_columns(from, columns - i);
        if (masked)
            value = select((real)0.0f, value, load_global(mask + (long)k * stride) > 0.0f);
        sum += taps[k + radius] * value;
    }
    store_global(sum, blurred + ((ulong)view * rows + j) * stride + MARGIN + i);
}

// Horizontal convolution with h, times the reciprocal of the mask's, minus the wide part, brought
// back from its rows.
kernel required_group void bandpass_columns(
    global float *restrict coefficients, // lined (views, rows, stride)
    const ulong coefficients_offset,
    global const float *restrict image, // lined (views, rows, stride), blurred along rows
    const ulong image_offset,
    global const float *restrict scale, // lined (rows, stride): 1 / blurred mask, or 0
    const ulong scale_offset,
    global const float *restrict taps, // (2 radius + 1,): h
    const ulong taps_offset,
    const int radius, // columns
    global const float *restrict expanded, // lined (views, coarse_rows, stride)
    const ulong expanded_offset,
    const int factor,
    const int coarse_rows,
    const int rows,
    const int columns,
    const int stride,
    const int views)
{
    coefficients += coefficients_offset;
    image += image_offset;
    scale += scale_offset;
    taps += taps_offset;
    expanded += expanded_offset;
    const int i = get_global_id(0) * LANES, j = get_global_id(1), view = get_global_id(2);
    if (i >= columns || j >= rows || view >= views)
        return;
    const ulong at = ((ulong)view * rows + j) * stride + MARGIN + i;
    const real s = load_global(scale + (ulong)j * stride + MARGIN + i);
    real value = 0.0f;
    for (int k = -radius; k <= radius; ++k)
        value += taps[k + radius] * load_global(image + at + k);
    value *= s;

    const float y = (j - 0.5f * (factor - 1)) / factor + RIM;
    const int base = (int)floor(y);
    float w[4];
    spline_weights(y - base, w);
    expanded += ((ulong)view * coarse_rows + base - 1) * stride + MARGIN + i;
    for (int k = 0; k < 4; ++k)
        value -= w[k] * load_global(expanded + (ulong)k * stride);
    value = select((real)0.0f, value, s > 0.0f);
    coefficients += at;
    store_global(value, coefficients);
    // The border goes on for the one column that the spline at the outermost pixels reaches.
    if (i == 0)
        coefficients[-1] = coefficients[0];
    if (i + LANES >= columns)
        coefficients[columns - i] = coefficients[columns - 1 - i];
}

// The band-passed image itself: the spline at the pixels; the border goes on outside.
kernel required_group void spline_values(
    global float *restrict values, // (views, rows, values_stride), lines from values_lead on
    const ulong values_offset,
    global const float *restrict coefficients, // lined (views, rows, stride)
    const ulong coefficients_offset,
    const int rows,
    const int columns,
    const int stride,
    const int values_stride,
    const int values_lead, // columns before each line: 0 or MARGIN
    const int views)
{
    values += values_offset;
    coefficients += coefficients_offset;
    const int i = get_global_id(0) * LANES, j = get_global_id(1), view = get_global_id(2);
    if (i >= columns || j >= rows || view >= views)
        return;
    real side = 0.0f, middle = 0.0f;
    for (int k = -1; k <= 1; ++k) {
        const int y = clamp(j + k, 0, rows - 1);
        global const float *p = coefficients + ((ulong)view * rows + y) * stride + MARGIN + i;
        const float weight = k ? 1.0f / 6.0f : 2.0f / 3.0f;
        middle += weight * load_global(p);
        side += weight * (load_global(p - 1) + load_global(p + 1));
    }
    const real value = (2.0f / 3.0f) * middle + (1.0f / 6.0f) * side;
    values += ((ulong)view * rows + j) * values_stride + values_lead + i;
    store_columns(value, values, columns - i);
}
