// Around the ramp filter: weight radiographs into padded lines, and cut the filtered lines out.
//
// A line of detector row r is p(c) factor row_weight(r) ray_weight(c) / sqrt(1 + a du^2 + b dv^2 +
// s du dv), du = c - c0 and dv = r - r0 pixels from the principal point: the root is the length of
// the ray over the distance from source to detector. Past the detector a line runs out from its
// outermost values, the last going right and, cyclically, the first going left, each times `roll`.
//
// Of each view the same `rows` rows are filtered, from row `top` of the detector on. Lines are
// numbered through all views: line = view * rows + row - top. A work-item makes LANES columns of one
// line. Global sizes are (blocks of LANES columns, lines), rounded up at will.

#include "ramp.clh"
#include "vectors.clh"

// of LANES neighbouring columns from column i on
static inline real weights_at(const LineWeight w, const int i)
{
    const real du = (i - w.c0) + RAMP;
    return w.factor / sqrt(w.quadratic + du * (w.linear + w.a * du));
}

kernel required_group void weight_lines(
    global float *restrict lines, // (count, padded)
    const ulong lines_offset,
    global const float *restrict projections, // (views, rows, columns), line integrals
    const ulong projections_offset,
    global const float *restrict view_table, // (views, VIEW_FIELDS)
    const ulong view_table_offset, // of the projections' first view
    global const float *restrict row_weight, // of all rows of the detector
    const ulong row_weight_offset,
    global const float *restrict ray_weight, // (views, columns) of the projections, or (columns,)
    const ulong ray_weight_offset,
    global const float *restrict roll, // (padded - columns,): what columns past the detector keep
    const ulong roll_offset,
    const int first, // line of the projections that becomes line 0
    const int count,
    const int rows,
    const int top,
    const int columns,
    const int padded, // >= 2 columns
    const int ray_stride) // columns, or 0 if all views have the same ray weights
{
    lines += lines_offset;
    projections += projections_offset;
    view_table += view_table_offset;
    row_weight += row_weight_offset;
    ray_weight += ray_weight_offset;
    roll += roll_offset;
    const int i = get_global_id(0) * LANES, line = get_global_id(1);
    if (i >= padded || line >= count)
        return;
    const int source = first + line;
    const LineWeight w = line_weight(view_table, row_weight, source / rows, top + source % rows);
    global const float *p = projections + (ulong)source * columns;
    lines += (ulong)line * padded + i;
    ray_weight += (ulong)(source / rows) * ray_stride;

    if (i + LANES <= columns) {
        const real ray = load_global(ray_weight + i);
        store_global(load_global(p + i) * weights_at(w, i) * ray, lines);
        return;
    }
    // From here on columns lie left of the detector rather than right of it.
    const int middle = columns + (padded - columns) / 2;
    if (i >= columns && i + LANES <= padded && (i + LANES <= middle || i >= middle)) {
        const int from = i < middle ? columns - 1 : 0;
        const float value = p[from] * weight_at(w, from) * ray_weight[from];
        store_global(value * load_global(roll + i - columns), lines);
        return;
    }
    const int last = min(LANES, padded - i);
    for (int k = 0; k < last; ++k) {
        const int x = i + k, from = source_column(x, columns, padded);
        const float value = p[from] * weight_at(w, from) * ray_weight[from];
        lines[k] = value * (x < columns ? 1.0f : roll[x - columns]);
    }
}

kernel required_group void cut_lines(
    global float *restrict filtered, // (views, height, columns), of a detector that may be wider
    const ulong filtered_offset,
    global const float *restrict lines, // (count, padded)
    const ulong lines_offset,
    const int first, // line of the projections that line 0 is
    const int count,
    const int rows,
    const int top,
    const int height, // rows of `filtered`
    const int columns, // of `filtered`
    const int padded,
    const int before) // columns of `filtered` left of the detector, at the lines' ends
{
    filtered += filtered_offset;
    lines += lines_offset;
    const int i = get_global_id(0) * LANES, line = get_global_id(1);
    if (i >= columns || line >= count)
        return;
    const int source = first + line;
    filtered += ((ulong)(source / rows) * height + top + source % rows) * columns + i;
    lines += (ulong)line * padded;
    const int from = i < before ? i - before + padded : i - before;
    if (i + LANES <= columns && from + LANES <= padded) {
        store_global(load_global(lines + from), filtered);
        return;
    }
    for (int k = 0; k < min(LANES, columns - i); ++k)
        filtered[k] = lines[from + k < padded ? from + k : from + k - padded];
}
