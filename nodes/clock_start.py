"""Batch fit for the first samples (prototype)."""
import math
import numpy as np
from nodes.clock_fit import P, hazard

class Start:
    def __init__(self, t0):
        self.t0 = t0
        self.t=[]; self.up=[]; self.lo=[]; self.rtt=[]
        self.tau=np.zeros(0); self.nu=np.zeros(0)
        self.spread=0.0
    def add(self, t, y, rtt):
        self.t.append(t-self.t0); self.up.append(y+rtt/2); self.lo.append(-y+rtt/2); self.rtt.append(rtt)
        self.tau=np.append(self.tau,[0.,0.]); self.nu=np.append(self.nu,[0.,0.])
        return self.solve()
    def solve(self):
        n=len(self.t)
        t=np.repeat(np.array(self.t),2); sign=np.tile([1.,-1.],n)
        H=np.stack([sign,sign*t,sign*t*t/2,np.ones(2*n)],1)
        B=np.stack([self.up,self.lo],1).ravel()
        rtt=np.array(self.rtt); i=int(rtt.argmin()); fast=float(rtt[i])
        y=(self.up[i]-self.lo[i])/2
        mean=np.array([y,0,0,fast*P.get('bm',.33)])
        prec=np.diag([1/(fast*1.0)**2,1/P["rate0"]**2,1/P["curv"]**2,1/(fast*P.get('bs',.33))**2])
        pm=prec@mean
        s0=float(np.sort(rtt)[n//2]-fast)/1.7 if n>2 else fast/6
        if n>2: s0=max(s0,fast/50)
        if self.spread==0.0 or n<6: self.spread=s0
        tau,nu=self.tau,self.nu
        damp=.6
        for it in range(int(P.get('sweeps',8))):
            S=np.linalg.inv(prec+(H*tau[:,None]).T@H)
            x=S@(pm+H.T@nu)
            HS=H@S
            v=np.einsum('ij,ij->i',HS,H); m=H@x
            # cavity
            cv=1/np.maximum(1/v-tau,1e-3/v); cm=cv*(m/v-nu)
            gap=B-m
            g=np.minimum(np.maximum(gap,0),5*self.spread)
            if n>=6:
                sp=(g.sum()+ 2*s0)/(2*n+2-1.5)
                self.spread=max(sp,fast/100,1e-7)
            lam=np.where(gap<P["soft"]*self.spread,1/self.spread,0.0)
            noise=(P["floor"]*self.spread)**2
            s=np.sqrt(cv+noise)
            k=(B-cm)/s-lam*s
            r=np.array([hazard(a) for a in k.tolist()])
            push=lam-r/s
            cut=np.clip(r*(k+r),1e-9,1-1e-9)/(s*s)
            # tilted: mean=cm+cv*push, var=cv-cv^2*cut ; site
            nt=cut/(1-cv*cut)
            nn=(cm*cut+push)/(1-cv*cut)
            tau=tau+damp*(nt-tau); nu=nu+damp*(nn-nu)
        self.tau,self.nu=tau,nu
        S=np.linalg.inv(prec+(H*tau[:,None]).T@H)
        x=S@(pm+H.T@nu)
        d=self.t[-1]
        F=np.eye(4); F[0,1]=d; F[0,2]=d*d/2; F[1,2]=d
        return F@x, F@S@F.T
