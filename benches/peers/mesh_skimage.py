import numpy as np, time, resource, sys, os, threading
from skimage import measure
import trimesh
path=sys.argv[1]; level=float(sys.argv[2])
g=np.load(path)
base=int(open('/proc/self/statm').read().split()[1])*4096
peak=[0]; stop=[False]
def watch():
    while not stop[0]:
        peak[0]=max(peak[0],int(open('/proc/self/statm').read().split()[1])*4096); time.sleep(0.01)
t=threading.Thread(target=watch); t.start()
ts=[]
for i in range(int(sys.argv[3]) if len(sys.argv)>3 else 1):
    t0=time.time()
    v,f,n,_=measure.marching_cubes(g,level)
    m=trimesh.Trimesh(v,f,vertex_normals=n,process=False)
    m.export('/tmp/sk.ply')
    ts.append(time.time()-t0)
    nv=len(v); nf=len(f); del v,f,n,m
stop[0]=True
print(nv,nf,'median s',sorted(ts)[len(ts)//2],'peak above grid MB',(peak[0]-base)/1e6)
