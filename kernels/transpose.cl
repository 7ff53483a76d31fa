// Transposition of planes, out(plane, column, before + row) = in(plane, row, column), where a step
// along each index has any stride.
//
// For projections, (view, row, column) <-> (view, column, row), a plane is a view; for volumes,
// (z, y, x) <-> (y, x, z), it is one y. What the output has beyond rows and columns of the input
// is filled with zeros. TILE x TILE elements go through local memory, so that neighbouring
// work-items read and write neighbours; for CPUs (LANES 8) through private memory of one work-item.
//
// A work-group moves one tile. Global size: (ceil(length / TILE), ceil(lines / TILE), planes)
// groups or more of local size (any, 1, 1), with LANES 8 of (1, 1, 1).

#include "group.clh"

#ifndef LANES
#define LANES 1 // 1 or 8
#endif
#ifndef TILE
#define TILE (LANES == 1 ? 32 : 8)
#endif

kernel required_group void transpose(
    global float *restrict out, // [plane out_plane + column out_line + before + row]
    const ulong out_offset,
    const int out_plane, // elements
    const int out_line, // elements
    const int lines, // of a plane of the output, >= columns
    const int length, // of a line of the output, >= before + rows
    global const float *restrict in, // [plane in_plane + row in_line + column]
    const ulong in_offset,
    const int in_plane, // elements
    const int in_line, // elements
    const int rows, // of a plane of the input
    const int columns, // of a plane of the input
    const int before, // zeros before row 0
    const int accumulate) // 1: add to the output
{
    const int first = get_group_id(0) * TILE; // in a line of the output
    const int line = get_group_id(1) * TILE;
    const size_t plane = get_group_id(2);
    out += out_offset + plane * out_plane;
    in += in_offset + plane * in_plane;
#if LANES == 1
    local float tile[TILE][TILE + 1]; // + 1: a column of the tile lies in different banks
    for (int e = get_local_id(0); e < TILE * TILE; e += get_local_size(0)) {
        const int i = e % TILE;
        const int j = e / TILE;
        const int row = first + j - before;
        const int column = line + i;
        const int inside = row >= 0 && row < rows && column < columns;
        tile[i][j] = inside ? in[(size_t)row * in_line + column] : 0.0f;
    }
    barrier(CLK_LOCAL_MEM_FENCE);
    for (int e = get_local_id(0); e < TILE * TILE; e += get_local_size(0)) {
        const int i = e % TILE;
        const int j = e / TILE;
        if (line + j < lines && first + i < length) {
            global float *target = out + (size_t)(line + j) * out_line + first + i;
            *target = accumulate ? *target + tile[j][i] : tile[j][i];
        }
    }
#else
    float tile[TILE][TILE];
    for (int j = 0; j < TILE; ++j)
        for (int i = 0; i < TILE; ++i)
            tile[j][i] = 0.0f;
    const int width = min(TILE, columns - line);
    for (int j = max(0, before - first); j < min(TILE, rows + before - first); ++j) {
        global const float *source = in + (size_t)(first + j - before) * in_line + line;
        if (width == TILE) // a loop of known length becomes one move
            for (int i = 0; i < TILE; ++i)
                tile[i][j] = source[i];
        else
            for (int i = 0; i < width; ++i)
                tile[i][j] = source[i];
    }
    const int height = min(TILE, length - first);
    for (int j = 0; j < min(TILE, lines - line); ++j) {
        global float *target = out + (size_t)(line + j) * out_line + first;
        if (height == TILE && !accumulate)
            for (int i = 0; i < TILE; ++i)
                target[i] = tile[j][i];
        else
            for (int i = 0; i < height; ++i)
                target[i] = accumulate ? target[i] + tile[j][i] : tile[j][i];
    }
#endif
}
