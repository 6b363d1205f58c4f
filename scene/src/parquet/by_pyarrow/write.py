"""Writes the tables beside it, which the tests of Parquet read: python3 write.py FOLDER, with pyarrow 26."""
import sys

import pyarrow as pa
import pyarrow.parquet as pq

out = sys.argv[1]
rows = range(5)
cols={
 "key.camera_name": pa.array(list(rows), pa.int8()),
 "[C].whole": pa.array([-r for r in rows], pa.int32()),
 "time": pa.array([r<<40 for r in rows], pa.int64()),
 "single": pa.array([r/3 for r in rows], pa.float32()),
 "double": pa.array([r/3 for r in rows], pa.float64()),
 "text": pa.array([f"object {r}" for r in rows], pa.string()),
 "photo": pa.array([bytes([r])*100*r for r in rows], pa.binary()),
 "small": pa.array([[1,r] for r in rows], pa.list_(pa.int8())),
 "shape": pa.array([[r,2,4] for r in rows], pa.list_(pa.int32(),3)),
 "values": pa.array([[float(10*r+i) for i in range(r)] for r in rows], pa.list_(pa.float32())),
 "pose": pa.array([[float(r)]*16 for r in rows], pa.list_(pa.float64(),16)),
}
t=pa.table(cols)
for name,kw in {"snappy":dict(compression="snappy"),"brotli":dict(compression="brotli"),"gzip":dict(compression="gzip",use_dictionary=False),
  "zstd_v2":dict(compression="zstd",data_page_version="2.0",version="2.6"),"snappy_v2":dict(compression="snappy",data_page_version="2.0",data_page_size=16,write_batch_size=2),
  "small_pages":dict(compression="none",use_dictionary=False,data_page_size=8,write_batch_size=1)}.items():
    pq.write_table(t, f"{out}/{name}.parquet", row_group_size=3, store_schema=False, write_statistics=(name=="snappy"), **kw)
