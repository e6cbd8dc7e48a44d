# ---
# jupyter:
#   jupytext:
#     text_representation: {extension: .py, format_name: percent}
#   kernelspec: {display_name: Python 3, language: python, name: python3}
# ---

# %% [markdown]
# # A log in a notebook
#
# A recorded drive becomes a map, a picture and a graph. Two drives become one map.
# `pip install '.[notebook]'` installs Jupyter and jupytext. Jupyter then opens this file as it is;
# `jupytext --to ipynb notebook.py` converts it.

# %%
from pathlib import Path
from tempfile import mkdtemp

from thinmap_ros import Pipeline, merge_maps, open_log, paired_scans, plot, shortest_path, write_map

ROOT = next(path for path in [Path.cwd(), *Path.cwd().parents] if (path / 'bags').is_dir())
scans = list(paired_scans(open_log(ROOT / 'bags' / 'office.mcap')))
len(scans)

# %% [markdown]
# ## Map a log


# %%
def mapped(drive):
    """The pipeline after all scans of a drive, in the frame of its first pose."""
    slam = Pipeline(resolution_m=0.05, max_range_m=8)
    for scan, T_odom_base in drive:
        slam.step(scan, T_odom_base)
    slam.finish()
    return slam


first = mapped(scans[:480])
print(first)

# %% [markdown]
# A pipeline is its picture: map, graph and path.

# %%
first

# %% [markdown]
# ## Find a path in the graph

# %%
graph = first.topology.map
start = graph.nearest_node((0.0, 0.0))
goal = graph.nearest_node((6.0, 5.0))
route = shortest_path(graph, start.id, goal.id)
print(f'{route.cost_m:.1f} m over nodes {route.node_ids}')

# %%
figure = plot(first, title='a path in the graph')
for edge_id in route.edge_ids:
    figure.axes[0].plot(*graph.edges[edge_id].path.T, color='#D55E00', linewidth=3.0, zorder=5)
figure

# %% [markdown]
# ## Merge two sessions
#
# The second robot started elsewhere, so that its map has another frame.

# %%
second = mapped(scans[140:])
folder = Path(mkdtemp())
files = [
    write_map(folder / 'first', first.grid.known_area()),
    write_map(folder / 'second', second.grid.known_area()),
]
merged = merge_maps(files)
for join in merged.joins:
    print('x, y, heading of the second map:', join.T_merged_map.round(2))
print(merged.topology.map)

# %%
plot(merged.grid.known_area(), merged.topology.map, title='two sessions')
