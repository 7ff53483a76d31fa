// Around the ramp filter: weight radiographs into padded lines, and cut the filtered lines out.
//
// A line of detector row r is p(c) * factor * row_weight(r) / sqrt(1 + a du^2 + b dv^2 + s du dv),
// du = c - c0 and dv = r - r0 pixels from the principal point: the root is the length of the ray
// over the distance from source to detector. Past the detector a line runs out from its outermost
// values, the last going right and, cyclically, the first going left, each times `roll`.
//
// Lines are numbered through all views: line = view * rows + row. A work-item makes LANES columns
// of one line. Global sizes are (blocks of LANES columns, lines), rounded up at will.

#include "vectors.clh"

#define VIEW_FIELDS 6 // c0, r0 [pixel], a, b, s [1/pixel^2], factor [1/mm]

typedef struct {
    float factor, c0, a, quadratic, linear;
} LineWeight;

static inline float weight_at(const LineWeight w, const int i)
{
    const float du = i - w.c0;
    return w.factor / sqrt(w.quadratic + du * (w.linear + w.a * du));
}

// of LANES neighbouring columns from column i on
static inline real weights_at(const LineWeight w, const int i)
{
    const real du = (i - w.c0) + RAMP;
    return w.factor / sqrt(w.quadratic + du * (w.linear + w.a * du));
}

kernel void weight_lines(
    global float *restrict lines, // (count, padded)
    const ulong lines_offset,
    global const float *restrict projections, // (views, rows, columns), line integrals
    const ulong projections_offset,
    global const float *restrict view_table, // (views, VIEW_FIELDS)
    const ulong view_table_offset, // of the projections' first view
    global const float *restrict row_weight, // (rows,)
    const ulong row_weight_offset,
    global const float *restrict roll, // (padded - columns,): what columns past the detector keep
    const ulong roll_offset,
    const int first, // line of the projections that becomes line 0
    const int count,
    const int rows,
    const int columns,
    const int padded) // >= 2 columns
{
    lines += lines_offset;
    projections += projections_offset;
    view_table += view_table_offset;
    row_weight += row_weight_offset;
    roll += roll_offset;
    const int i = get_global_id(0) * LANES, line = get_global_id(1);
    if (i >= padded || line >= count)
        return;
    const int source = first + line, row = source % rows;
    global const float *view = view_table + (source / rows) * VIEW_FIELDS;
    const float dv = row - view[1];
    LineWeight w;
    w.factor = view[5] * row_weight[row];
    w.c0 = view[0];
    w.a = view[2];
    w.quadratic = 1.0f + view[3] * dv * dv;
    w.linear = view[4] * dv;
    global const float *p = projections + (ulong)source * columns;
    lines += (ulong)line * padded + i;

    if (i + LANES <= columns) {
        store_global(load_global(p + i) * weights_at(w, i), lines);
        return;
    }
    // From here on columns lie left of the detector rather than right of it.
    const int middle = columns + (padded - columns) / 2;
    if (i >= columns && i + LANES <= padded && (i + LANES <= middle || i >= middle)) {
        const int from = i < middle ? columns - 1 : 0;
        store_global(p[from] * weight_at(w, from) * load_global(roll + i - columns), lines);
        return;
    }
    const int last = min(LANES, padded - i);
    for (int k = 0; k < last; ++k) {
        const int x = i + k, from = x < columns ? x : (x < middle ? columns - 1 : 0);
        lines[k] = p[from] * weight_at(w, from) * (x < columns ? 1.0f : roll[x - columns]);
    }
}

kernel void cut_lines(
    global float *restrict filtered, // (views, rows, columns)
    const ulong filtered_offset,
    global const float *restrict lines, // (count, padded)
    const ulong lines_offset,
    const int first, // line of `filtered` that line 0 becomes
    const int count,
    const int columns,
    const int padded)
{
    filtered += filtered_offset;
    lines += lines_offset;
    const int i = get_global_id(0) * LANES, line = get_global_id(1);
    if (i >= columns || line >= count)
        return;
    filtered += (ulong)(first + line) * columns + i;
    lines += (ulong)line * padded + i;
    if (i + LANES <= columns) {
        store_global(load_global(lines), filtered);
        return;
    }
    for (int k = 0; k < columns - i; ++k)
        filtered[k] = lines[k];
}
