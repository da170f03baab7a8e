/* Declarations of PX4 1.15 to 1.17, as a firmware engineer sees them: names, types and what is private. Written for tests. MIT. */
#pragma once
#include "param.h"
class ModuleParams
{
public:
	ModuleParams(ModuleParams *) {}
	virtual ~ModuleParams() {}
	ModuleParams(const ModuleParams &) = delete;
	ModuleParams &operator=(const ModuleParams &) = delete;

protected:
	virtual void updateParams() { updateParamsImpl(); }
	virtual void updateParamsImpl() {}
};
