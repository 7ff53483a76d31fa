// The filter of Katsevich's reconstruction from a helix, as Noo, Pack and Heuscher give it for flat
// detectors: derivative along the helix at constant direction, and resampling to filter lines and
// back. The Hilbert transform along the lines comes between these two.
//
// Positions on the detector are tangents, t_u along rows and t_v along z, of the angle to its
// normal. A work-item makes LANES columns of one line. Global sizes are (blocks of LANES columns,
// lines, views), rounded up at will.

#include "vectors.clh"

// Linear interpolation across lines, `stride` apart, at a position of its own for each column.
// Positions of neighbouring columns are near each other: all lines among them are read whole.
static inline real across_lines(
    global const float *lines, const int stride, const real position, const int count)
{
    float at[LANES];
    store_lanes(position, at);
    float low = at[0], high = at[0];
    for (int k = 1; k < LANES; ++k) {
        low = at[k] < low ? at[k] : low;
        high = at[k] > high ? at[k] : high;
    }
    real sum = 0.0f;
    for (int line = (int)low; line < high + 1.0f; ++line) {
        const real weight = fmax(1.0f - fabs(position - (float)line), 0.0f);
        sum += weight * load_columns(lines + (ulong)line * stride, count);
    }
    return sum;
}

// out = (d/dlambda + (1 + t_u^2) d/dt_u + t_u t_v d/dt_v) p / sqrt(1 + t_u^2 + t_v^2) in the middle
// between 2 x 2 x 2 pixels of successive views, rows and columns.
kernel required_group void differentiate(
    global float *restrict out, // (views, height, columns - 1)
    const ulong out_offset,
    global const float *restrict projections, // (views + 1, rows, columns), line integrals
    const ulong projections_offset,
    const int columns,
    const int rows,
    const int first, // row of the detector from which on, >= 0
    const int height, // < rows - first
    const int views,
    const float principal_column, // foot of the perpendicular from the source [pixel]
    const float principal_row,
    const float step_u, // t_u from column to column
    const float step_v, // t_v from row to row
    const float angle_step) // from view to view [rad]
{
    out += out_offset;
    projections += projections_offset;
    const int i = get_global_id(0) * LANES, row = get_global_id(1), view = get_global_id(2);
    if (i >= columns - 1 || row >= height || view >= views)
        return;
    const int count = min(LANES, columns - 1 - i);
    global const float *p = projections + ((ulong)view * rows + first + row) * columns + i;
    global const float *q = p + (ulong)rows * columns;
    // p before and q after, by row and column
    const real p00 = load_columns(p, count), p01 = load_columns(p + 1, count);
    const real p10 = load_columns(p + columns, count), p11 = load_columns(p + columns + 1, count);
    const real q00 = load_columns(q, count), q01 = load_columns(q + 1, count);
    const real q10 = load_columns(q + columns, count), q11 = load_columns(q + columns + 1, count);
    const real left = (p00 + q00) + (p10 + q10), right = (p01 + q01) + (p11 + q11);
    const real low = (p00 + q00) + (p01 + q01), high = (p10 + q10) + (p11 + q11);
    const real before = (p00 + p01) + (p10 + p11), after = (q00 + q01) + (q10 + q11);
    const real u = (i + 0.5f - principal_column + RAMP) * step_u;
    const float v = (first + row + 0.5f - principal_row) * step_v;
    const real sum = (after - before) * (0.25f / angle_step) +
                       (1.0f + u * u) * (right - left) * (0.25f / step_u) +
                       u * v * (high - low) * (0.25f / step_v);
    out += ((ulong)view * height + row) * (columns - 1) + i;
    store_columns(sum / sqrt(1.0f + u * u + v * v), out, count);
}

// Along filter line n, columns j of the derivative's rows position[2n] + position[2n + 1] j. Beyond
// the detector's first and last row these go on. Zeros follow up to `padded`.
kernel required_group void take_lines(
    global float *restrict lines, // (views, count, padded)
    const ulong lines_offset,
    global const float *restrict image, // (views, height, width)
    const ulong image_offset,
    global const float *restrict position, // (count, 2) [row, row / column]
    const ulong position_offset,
    const int width,
    const int height,
    const int count, // lines
    const int padded, // >= width
    const int views)
{
    lines += lines_offset;
    image += image_offset;
    position += position_offset;
    const int i = get_global_id(0) * LANES, line = get_global_id(1), view = get_global_id(2);
    if (i >= padded || line >= count || view >= views)
        return;
    real value = 0.0f;
    if (i < width) {
        const int valid = min(LANES, width - i);
        const real row = position[2 * line] +
                           position[2 * line + 1] * (i + RAMP);
        value = across_lines(
            image + (ulong)view * height * width + i,
            width,
            clamp(row, 0.0f, height - 1.0f),
            valid);
    }
    store_columns(
        value, lines + ((ulong)view * count + line) * padded + i, min(LANES, padded - i));
}

// From filtered lines back to rows and columns of the detector: out(row, j) is column j of line
// position(row, j).
kernel required_group void put_lines(
    global float *restrict out, // (views, rows, columns)
    const ulong out_offset,
    global const float *restrict lines, // (views, count, padded)
    const ulong lines_offset,
    global const float *restrict position, // (rows, stride), 0 to count - 1
    const ulong position_offset,
    const int stride, // whole LANES, >= columns
    const int columns,
    const int rows,
    const int count, // lines
    const int padded, // >= columns
    const int views)
{
    out += out_offset;
    lines += lines_offset;
    position += position_offset;
    const int i = get_global_id(0) * LANES, row = get_global_id(1), view = get_global_id(2);
    if (i >= columns || row >= rows || view >= views)
        return;
    const int valid = min(LANES, columns - i);
    const real at = load_global(position + (ulong)row * stride + i);
    const real value =
        across_lines(lines + (ulong)view * count * padded + i, padded, at, valid);
    store_columns(value, out + ((ulong)view * rows + row) * columns + i, valid);
}
